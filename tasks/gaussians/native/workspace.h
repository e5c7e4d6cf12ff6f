// What a training keeps from one iteration to the next, so that nothing is allocated in between.
#pragma once

#include "binning.h"

struct Part {  // of a row
    int begin, end;
};

struct Workspace {
    binning::Frame frame;
    struct {
        parallel::Buffer<float> share, x, y, towards_mean, towards_square, towards_product;
        parallel::Buffer<double> sums;
        parallel::Buffer<Part> counted;
    } loss;
};

template <class F>
int guarded(F work) {  // 0 = done, 1 = out of memory
    try {
        work();
        return 0;
    } catch (const std::exception&) {
        return 1;
    }
}
