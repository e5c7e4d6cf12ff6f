// Which Gaussians reach which 4x4-pixel block, front to back.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "projection.h"

namespace binning {

constexpr float kLog2E = 1.4426950408889634f;

// What the blending reads: alpha = 2^(log2_opacity + dx (A dx + B dy) + C dy^2), d = pixel - mean.
struct alignas(64) Splat {
    float u, v, A, B, C, log2_opacity;
    float color[3], z;
    int32_t label, row;
};

struct Frame {
    int blocks_x, blocks_y;
    std::vector<Splat> splats;          // in order of depth, ties by row
    std::vector<int64_t> first;         // [blocks + 1] into entries
    std::vector<int32_t> entries;       // ranks of splats
};

// Sorts (key, row) pairs by key, stable: three passes of 11 bits.
inline void radix_sort(std::vector<uint64_t>& items) {
    std::vector<uint64_t> other(items.size());
    for (int shift = 32; shift < 64; shift += 11) {
        size_t counts[2049] = {};
        for (uint64_t x : items) ++counts[((x >> shift) & 2047) + 1];
        for (int k = 0; k < 2048; ++k) counts[k + 1] += counts[k];
        for (uint64_t x : items) other[counts[(x >> shift) & 2047]++] = x;
        items.swap(other);
    }
}

// The columns of one ellipse {d' K d <= reach} that lie between two heights, relative to its centre.
struct Ellipse {
    float k00, k01, k11, det, reach, half_width, half_height, dy_rightmost;

    Ellipse(const projection::Footprint& f, float reach_) : k00(f.k00), k01(f.k01), k11(f.k11), reach(reach_) {
        half_width = std::sqrt(reach * f.c00);
        half_height = std::sqrt(reach * f.c11);
        dy_rightmost = half_width * (f.c01 / f.c00);
        det = k11 / f.c00;  // k00 k11 - k01^2, without its cancellation
    }
    bool columns(float low, float high, float& left, float& right) const {
        low = std::fmax(low, -half_height), high = std::fmin(high, half_height);
        if (low > high) return false;
        const float at_right = std::fmin(std::fmax(dy_rightmost, low), high);
        const float at_left = std::fmin(std::fmax(-dy_rightmost, low), high);
        right = edge(at_right, 1), left = edge(at_left, -1);
        return true;
    }

  private:
    // k00 x^2 + 2 k01 x dy + k11 dy^2 = reach, solved for x.
    float edge(float dy, float side) const {
        const float root = std::fmax(k00 * reach - det * dy * dy, 0.0f);
        return (-k01 * dy + side * std::sqrt(root)) / k00;
    }
};

inline void bin(const Scene& s, float* radii, Frame& frame) {
    const projection::View view = projection::view_of(s);
    frame.blocks_x = (s.width + 3) / 4, frame.blocks_y = (s.height + 3) / 4;
    const int64_t blocks = (int64_t)frame.blocks_x * frame.blocks_y;

    struct Candidate {
        projection::Footprint f;
        Ellipse ellipse;
        int64_t row;
    };
    std::vector<Candidate> candidates;
    std::vector<uint64_t> order;
    candidates.reserve(s.count), order.reserve(s.count);
    std::memset(radii, 0, s.count * sizeof(float));
    projection::Footprint f;
    for (int64_t i = 0; i < s.count; ++i) {
        if (!projection::project(s, view, i, f)) continue;
        // alpha >= 1 / 255 as far as q <= 2 ln(255 o); a hair more, since alpha is computed with rounding.
        const float reach = 2 * (f.log2_opacity / kLog2E + 5.5412635f) * 1.0001f + 1e-4f;
        const Ellipse e(f, reach);
        if (f.u + e.half_width < 0.5f || f.u - e.half_width > s.width - 0.5f || f.v + e.half_height < 0.5f ||
            f.v - e.half_height > s.height - 0.5f)
            continue;
        uint32_t key;
        std::memcpy(&key, &f.z, sizeof key);
        order.push_back((uint64_t)key << 32 | candidates.size());
        candidates.push_back({f, e, i});
        radii[i] = std::fmax(e.half_width, e.half_height);
    }
    radix_sort(order);

    struct Span {
        int32_t splat;
        int32_t length;
        int64_t block;
    };
    std::vector<Span> spans;
    spans.reserve(4 * order.size());
    frame.splats.resize(order.size());
    frame.first.assign(blocks + 2, 0);
    int64_t* change = frame.first.data() + 1;
    for (size_t rank = 0; rank < order.size(); ++rank) {
        const Candidate& c = candidates[order[rank] & 0xffffffffu];
        Splat& p = frame.splats[rank];
        p.u = c.f.u, p.v = c.f.v, p.z = c.f.z, p.row = (int32_t)c.row;
        p.A = -0.5f * kLog2E * c.f.k00, p.B = -kLog2E * c.f.k01, p.C = -0.5f * kLog2E * c.f.k11;
        p.log2_opacity = c.f.log2_opacity, p.label = s.labels ? s.labels[c.row] : -1;
        harmonics::evaluate(s, view.center, c.row, p.color);
        const float top = p.v - c.ellipse.half_height, bottom = p.v + c.ellipse.half_height;
        const int y0 = (int)std::fmax(std::ceil((top - 3.501f) / 4), 0.0f);
        const int y1 = (int)std::fmin(std::floor((bottom - 0.499f) / 4), frame.blocks_y - 1.0f);
        for (int y = y0; y <= y1; ++y) {
            float left, right;
            if (!c.ellipse.columns(4 * y + 0.5f - p.v, 4 * y + 3.5f - p.v, left, right)) continue;
            const float slack = 1e-3f + 1e-5f * (right - left);
            left += p.u - slack, right += p.u + slack;
            const int x0 = (int)std::fmin(std::fmax(std::ceil((left - 3.5f) / 4), 0.0f), 1e9f);
            const int x1 = (int)std::fmax(std::fmin(std::floor((right - 0.5f) / 4), frame.blocks_x - 1.0f), -1.0f);
            if (x0 > x1) continue;
            const int64_t block = (int64_t)y * frame.blocks_x + x0;
            spans.push_back({(int32_t)rank, x1 - x0 + 1, block});
            ++change[block], --change[block + x1 - x0 + 1];
        }
    }
    // change holds differences: a running sum gives the counts, another the first entries.
    int64_t count = 0, total = 0;
    for (int64_t b = 0; b < blocks; ++b) {
        count += change[b];
        change[b] = total;
        total += count;
    }
    frame.entries.resize(total);
    for (const Span& span : spans)
        for (int64_t b = span.block; b < span.block + span.length; ++b) frame.entries[change[b]++] = span.splat;
    frame.first.resize(blocks + 1);
    frame.first[0] = 0;
}

}  // namespace binning
