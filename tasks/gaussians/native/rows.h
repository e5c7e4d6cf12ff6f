// Sixteen Gaussians at a time, one in each lane.
#pragma once

#include "lanes.h"
#include "scene.h"

struct Rows {
    int64_t at[16];  // beyond `count` the last one is repeated
    int count;

    // Element `column` of each row of a [N, width] array.
    lanes::V16 column(const float* base, int width, int column) const {
        alignas(64) float lane[16];
        for (int k = 0; k < 16; ++k) lane[k] = base[at[k] * width + column];
        return lanes::load(lane);
    }
    void put(float* base, int width, int column, const lanes::V16& value) const {
        alignas(64) float lane[16];
        lanes::store(lane, value);
        for (int k = 0; k < count; ++k) base[at[k] * width + column] = lane[k];
    }
};
