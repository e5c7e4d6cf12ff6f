// Work shared by a few threads, and memory that is kept from one call to the next.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

namespace parallel {

// Calls work(0) ... work(count - 1), each once. Which thread does what is left to chance, so results must not depend
// on it: `work` writes only what belongs to its index.
template <class F>
void each(int threads, int64_t count, F work) {
    threads = (int)std::min<int64_t>(threads, count);
    if (threads <= 1) {
        for (int64_t i = 0; i < count; ++i) work(i);
        return;
    }
    std::atomic<int64_t> next{0};
    std::atomic<bool> failed{false};
    const auto run = [&] {
        try {
            for (int64_t i; !failed && (i = next++) < count;) work(i);
        } catch (const std::exception&) {
            failed = true;
        }
    };
    std::vector<std::thread> others;
    try {
        for (int k = 1; k < threads; ++k) others.emplace_back(run);
    } catch (const std::system_error&) {
        // No more threads to be had: those that are there do the work.
    }
    run();
    for (std::thread& t : others) t.join();
    if (failed) throw std::bad_alloc();
}

// Room for plain values that grows and never shrinks; growing loses the content.
template <class T>
class Buffer {
  public:
    T* room(int64_t count) {
        if (count > capacity_) {
            // Half as much again: counts go up and down a little from view to view.
            const int64_t wanted = count + count / 2;
            data_.reset();
            capacity_ = 0;
            data_.reset(static_cast<T*>(::operator new(wanted * sizeof(T), std::align_val_t(64))));
            capacity_ = wanted;
        }
        return data_.get();
    }
    T* data() { return data_.get(); }
    const T* data() const { return data_.get(); }
    T& operator[](int64_t i) { return data_.get()[i]; }
    const T& operator[](int64_t i) const { return data_.get()[i]; }

  private:
    struct Free {
        void operator()(T* p) const { ::operator delete(p, std::align_val_t(64)); }
    };
    std::unique_ptr<T, Free> data_;
    int64_t capacity_ = 0;
};

}  // namespace parallel
