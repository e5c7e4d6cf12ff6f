// Work shared by a few threads, and memory that is kept from one call to the next.
#pragma once

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

namespace parallel {

// Threads that help one caller and sleep between its calls: to start one takes as long as a small piece of work. One
// that wakes too late finds nothing to do, and nobody waits for it.
class Crew {
  public:
    ~Crew() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            ending_ = true;
        }
        wake_.notify_all();
        for (std::thread& thread : threads_) thread.join();
    }

    // Calls `work` once, and so do as many of `helpers` others as are awake before it has returned. `work` throws nothing.
    template <class F>
    void share(int helpers, F& work) {
        grow(helpers);
        {
            std::lock_guard<std::mutex> lock(mutex_);
            work_ = [&work] { work(); };
            wanted_ = helpers, ++call_;
        }
        wake_.notify_all();
        work();
        std::unique_lock<std::mutex> lock(mutex_);
        wanted_ = 0;
        done_.wait(lock, [this] { return busy_ == 0; });
    }

  private:
    void grow(int helpers) {
        try {
            while ((int)threads_.size() < helpers) threads_.emplace_back([this] { help(); });
        } catch (const std::system_error&) {
            // No more threads to be had: those that are there do the work.
        }
    }

    void help() {
        std::unique_lock<std::mutex> lock(mutex_);
        for (int64_t seen = 0;;) {
            wake_.wait(lock, [&] { return ending_ || (wanted_ > 0 && seen != call_); });
            if (ending_) return;
            seen = call_;
            --wanted_, ++busy_;
            lock.unlock();
            work_();
            lock.lock();
            if (--busy_ == 0) done_.notify_one();
        }
    }

    std::vector<std::thread> threads_;
    std::mutex mutex_;  // of all below
    std::condition_variable wake_, done_;
    std::function<void()> work_;
    int64_t call_ = 0;
    int wanted_ = 0, busy_ = 0;  // helpers that may still begin, and those that work
    bool ending_ = false;
};

// That of the calling thread. A process that was forked has none of its parent's threads: it leaves what it inherited
// where it is, for even to end it would wait for them.
inline Crew& crew() {
    thread_local struct Own {
        Crew* crew = nullptr;
        pid_t process = 0;
        ~Own() {
            if (process == getpid()) delete crew;
        }
    } own;
    if (own.process != getpid()) own.crew = new Crew, own.process = getpid();
    return *own.crew;
}

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
    crew().share(threads - 1, run);
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
