// Which Gaussians reach which 4x4-pixel block, front to back. The image is cut into bands of eight rows of blocks, each
// with its own copy of the splats that reach it: bands share nothing, so any number of threads gives the same bytes.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstring>

#include "parallel.h"
#include "projection.h"

namespace binning {

using lanes::splat;
using lanes::V16;
using parallel::Buffer;

constexpr int kBandRows = 8;
constexpr int64_t kChunk = 1024;  // Gaussians that are projected in one piece
constexpr int kAhead = 8;         // so many entries ahead, splats are fetched into the cache
constexpr int kStride = 4;        // blocks that get an entry at a time

// What the blending reads: alpha = 2^(log2_opacity + A (dx + shear dy)^2 + C dy^2), d = pixel - mean; A and C are below
// zero. And the ellipse where alpha reaches 1/255: half its width and height, the correlation of x and y, and
// sqrt(1 - correlation^2).
struct alignas(64) Splat {
    float u, v, A, shear, C, log2_opacity;
    float color[3], z;
    int32_t label, row;
    float half_width, half_height, correlation, chord;
};
static_assert(sizeof(Splat) == 64, "sixteen splats are written as a transposed square");

// Sums over the pixels for one splat in one band: moments 1, x, y, xx, xy, yy of dL/d(log alpha), where x stands for
// dx + shear dy; dL/d(color); dL/dz.
struct alignas(64) Sums {
    float value[16];
};

// How much one splat shows in one band, in the pixels of one id: a sum of weights. A splat's shares are linked.
struct Share {
    int32_t splat, id, next;
    float weight;
};

struct Span {
    int32_t splat, block, length;
};

struct Range {
    int first, last;
};

struct Band {
    int top, rows;                 // of blocks
    int64_t count;                 // of splats
    Buffer<uint64_t> order, other; // depth and candidate
    Buffer<Splat> splats;          // by depth, ties by row
    Buffer<Span> spans;
    Buffer<int64_t> first, end;    // [blocks] into entries
    Buffer<int32_t> entries;       // splats of each block, front to back
    Buffer<int32_t> used;          // [blocks] entries up to the one that made the block opaque
    Buffer<Sums> sums;
    Buffer<float> strongest;
    Buffer<int32_t> first_share;   // of each splat, -1 = none
    std::vector<Share> shares;
};

struct Frame {
    int blocks_x, blocks_y;
    int64_t chunks;
    Buffer<Splat> candidates;      // chunk c writes from c * kChunk
    Buffer<int32_t> chunk_count;
    Buffer<int64_t> chunk_places;  // of the chunk's candidates in all bands; then where they begin in `places`
    Buffer<int64_t> chunk_bands;   // [chunks, num_bands] how many of them reach a band; then where they begin there
    Buffer<Range> rows;            // of blocks, of each candidate
    Buffer<int64_t> place_first;   // of each candidate: places[place_first + band] is its splat there
    Buffer<int32_t> places;
    int num_bands;
    std::vector<Band> bands;       // never fewer than before, so that their memory stays
};

inline Range block_rows(const Frame& frame, const Splat& p) {
    return {(int)std::fmax(std::ceil((p.v - p.half_height - 3.501f) / 4), 0.0f),
            (int)std::fmin(std::floor((p.v + p.half_height - 0.499f) / 4), frame.blocks_y - 1.0f)};
}

inline V16 as_floats(const int32_t (&lane)[16]) {
    float bits[16];
    std::memcpy(bits, lane, sizeof bits);
    return lanes::load(bits);
}

// Projects the rows of a chunk; what can be seen becomes candidates.
inline void project_chunk(const Scene& s, const projection::View& view, int64_t chunk, float* radii, Frame& frame) {
    Splat* to = frame.candidates.data() + chunk * kChunk;
    int64_t* in_band = frame.chunk_bands.data() + chunk * frame.num_bands;
    std::fill_n(in_band, frame.num_bands, 0);
    int64_t places = 0;
    const int64_t end = std::min(s.count, (chunk + 1) * kChunk);
    for (int64_t begin = chunk * kChunk; begin < end; begin += 16) {
        Rows rows;
        rows.count = (int)std::min<int64_t>(16, end - begin);
        for (int k = 0; k < 16; ++k) rows.at[k] = begin + std::min(k, rows.count - 1);
        const projection::Footprint f = projection::project(s, view, rows);
        // alpha >= 1 / 255 as far as q <= 2 ln(255 o); a hair more, since alpha is computed with rounding.
        const float scale = 2 / projection::kLog2E;
        const V16 reach = (f.log2_opacity - projection::kLog2MinAlpha) * (scale * 1.0001f) + 1e-4f;
        const V16 half_width = lanes::square_root(reach * f.c00), half_height = lanes::square_root(reach * f.c11);
        const V16 seen = f.visible * lanes::less(splat(0.5f), f.u + half_width) *
                         lanes::less(f.u - half_width, splat(s.width - 0.5f)) *
                         lanes::less(splat(0.5f), f.v + half_height) *
                         lanes::less(f.v - half_height, splat(s.height - 0.5f));
        alignas(64) float is_seen[16], radius[16];
        lanes::store(is_seen, seen);
        lanes::store(radius, lanes::maximum(half_width, half_height));
        bool any = false;
        for (int k = 0; k < rows.count; ++k) {
            radii[begin + k] = is_seen[k] > 0 ? radius[k] : 0;
            any |= is_seen[k] > 0;
        }
        if (!any) continue;
        V16 color[3];
        harmonics::evaluate(s, view.center, rows, f.mean, color);
        int32_t label[16], row[16];
        for (int k = 0; k < 16; ++k) row[k] = (int32_t)rows.at[k], label[k] = s.labels ? s.labels[rows.at[k]] : -1;
        const float half = -0.5f * projection::kLog2E;
        const V16 correlation = f.c01 / lanes::square_root(f.c00 * f.c11);
        V16 fields[16] = {f.u, f.v, half * f.kx, f.shear, half * f.ky, f.log2_opacity,
                          color[0], color[1], color[2], f.z, as_floats(label), as_floats(row),
                          half_width, half_height, correlation, f.chord};
        lanes::transpose(fields);
        for (int k = 0; k < rows.count; ++k) {
            if (!(is_seen[k] > 0)) continue;
            lanes::store(reinterpret_cast<float*>(to), fields[k]);
            const Range reached = frame.rows[to - frame.candidates.data()] = block_rows(frame, *to);
            const int first = reached.first / kBandRows, last = reached.last / kBandRows;
            for (int b = first; b <= last; ++b) ++in_band[b];
            places += last - first + 1;
            ++to;
        }
    }
    frame.chunk_count[chunk] = (int32_t)(to - (frame.candidates.data() + chunk * kChunk));
    frame.chunk_places[chunk] = places;
}

// Makes room in each band for the candidates that reach it.
inline void allot(Frame& frame) {
    int64_t places = 0;
    for (int64_t c = 0; c < frame.chunks; ++c) {
        const int64_t count = frame.chunk_places[c];
        frame.chunk_places[c] = places, places += count;
    }
    frame.places.room(places);
    for (int b = 0; b < frame.num_bands; ++b) {
        Band& band = frame.bands[b];
        band.count = 0;
        for (int64_t c = 0; c < frame.chunks; ++c) {
            int64_t& of_chunk = frame.chunk_bands[c * frame.num_bands + b];
            const int64_t count = of_chunk;
            of_chunk = band.count, band.count += count;
        }
        band.order.room(band.count);
    }
}

// Tells each band which candidates of a chunk reach it.
inline void distribute(int64_t chunk, Frame& frame) {
    int64_t places = frame.chunk_places[chunk], *in_band = frame.chunk_bands.data() + chunk * frame.num_bands;
    for (int64_t k = chunk * kChunk; k < chunk * kChunk + frame.chunk_count[chunk]; ++k) {
        const int first = frame.rows[k].first / kBandRows, last = frame.rows[k].last / kBandRows;
        frame.place_first[k] = places - first;
        places += last - first + 1;
        uint32_t depth;  // positive, so its bits are in its order
        std::memcpy(&depth, &frame.candidates[k].z, sizeof depth);
        for (int b = first; b <= last; ++b) frame.bands[b].order[in_band[b]++] = (uint64_t)depth << 32 | (uint64_t)k;
    }
}

// By depth, ties by row.
inline void sort(Band& band) {
    uint64_t *items = band.order.data(), *spare = band.other.room(band.count);
    if (band.count < 64) {
        std::sort(items, items + band.count);
        return;
    }
    for (int shift = 32; shift < 64; shift += 8) {  // four stable passes; the candidates are in order already
        int64_t start[257] = {};
        for (int64_t k = 0; k < band.count; ++k) ++start[((items[k] >> shift) & 255) + 1];
        for (int k = 0; k < 256; ++k) start[k + 1] += start[k];
        for (int64_t k = 0; k < band.count; ++k) spare[start[(items[k] >> shift) & 255]++] = items[k];
        std::swap(items, spare);
    }
}

alignas(64) constexpr float kBlockRow[16] = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};
alignas(64) constexpr float kSide[16] = {-1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1, 1};

// The blocks that an ellipse meets in each of a band's eight rows: lanes 0..7 the first, 8..15 one past the last. At
// the height t (in halves of its own) its sides are at correlation * t -+ chord * sqrt(1 - t^2).
inline void columns(const Splat& p, int top, int blocks_x, int32_t (&out)[16]) {
    const V16 side = lanes::load(kSide);
    const float inverse = 1 / p.half_height;
    const V16 low = (lanes::load(kBlockRow) * 4.0f + (4 * top + 0.5f - p.v)) * inverse, high = low + 3 * inverse;
    V16 t = lanes::minimum(lanes::maximum(side * p.correlation, low), high);
    t = lanes::clamp(t, -1, 1);
    const V16 root = lanes::square_root(lanes::maximum(1.0f - t * t, splat(0)));
    const float slack = 1e-3f + 2e-5f * p.half_width;
    const V16 x = p.u + p.half_width * (t * p.correlation + side * root * p.chord) + side * slack;
    // Left: the first block whose last pixel is not left of x. Right: one past the last whose first is not right of x.
    const V16 block = lanes::clamp(x * 0.25f + (side * 0.375f + 0.5f), 0, (float)blocks_x);
    const lanes::I16 whole = lanes::truncate_lanes(block);
    std::memcpy(out, &whole, sizeof out);
}

// Lists each block's splats, front to back.
inline void fill(Band& band, Frame& frame) {
    sort(band);
    band.splats.room(band.count);
    const int64_t blocks = (int64_t)band.rows * frame.blocks_x;
    int64_t *first = band.first.room(blocks + kStride), *end = band.end.room(blocks + kStride);
    std::memset(end, 0, (blocks + kStride) * sizeof *end);
    const int number = band.top / kBandRows;
    Span* spans = band.spans.room(band.count * kBandRows);
    int64_t num_spans = 0;
    const auto candidate_at = [&](int64_t k) { return (int64_t)(band.order[k] & 0xffffffffu); };
    for (int64_t begin = 0; begin < band.count; begin += 16) {
        const int some = (int)std::min<int64_t>(16, band.count - begin);
        int32_t block[16][16];
        Range rows[16];
        for (int i = 0; i < some; ++i) {
            const int64_t k = begin + i, candidate = candidate_at(k);
            if (k + 12 < band.count) {  // the order of depth jumps about in memory
                __builtin_prefetch(&frame.candidates[candidate_at(k + 12)]);
                __builtin_prefetch(&frame.rows[candidate_at(k + 12)]);
            }
            band.splats[k] = frame.candidates[candidate];
            frame.places[frame.place_first[candidate] + number] = (int32_t)k;
            columns(band.splats[k], band.top, frame.blocks_x, block[i]);
            rows[i] = frame.rows[candidate];
        }
        // Apart: each of these branches that is mispredicted would hold up the vectors above.
        for (int i = 0; i < some; ++i) {
            const int past = std::min(rows[i].last - band.top + 1, band.rows);
            for (int r = std::max(rows[i].first - band.top, 0); r < past; ++r) {
                const int32_t length = block[i][8 + r] - block[i][r], from = r * frame.blocks_x + block[i][r];
                if (length <= 0) continue;
                spans[num_spans++] = {(int32_t)(begin + i), from, length};
                ++end[from], --end[from + length];
            }
        }
    }
    // `end` holds differences of counts: a running sum gives the counts, another where each block begins. Each has a
    // place to spare.
    int64_t count = 0, total = 0;
    for (int64_t b = 0; b < blocks + kStride; ++b) {
        count += end[b];
        first[b] = end[b] = total;
        total += count + 1;
    }
    int32_t* entries = band.entries.room(total + kAhead);
    for (int64_t k = 0; k < num_spans; ++k) {
        const Span span = spans[k];
        for (int32_t b = 0; b < span.length; b += kStride) {
            int64_t* next = end + span.block + b;
            // No branch for each block: what is written beyond the span, the block's next splat or the end replaces.
            for (int j = 0; j < kStride; ++j) {
                entries[next[j]] = span.splat;
                next[j] += b + j < span.length;
            }
        }
    }
    // What is fetched ahead may lie in the spare places.
    for (int64_t b = 0; b < blocks; ++b) entries[end[b]] = 0;
    std::memset(entries + end[blocks], 0, (total + kAhead - end[blocks]) * sizeof *entries);
}

inline void prepare(const Scene& s, Frame& frame) {
    frame.blocks_x = (s.width + 3) / 4, frame.blocks_y = (s.height + 3) / 4;
    frame.chunks = (s.count + kChunk - 1) / kChunk;
    frame.candidates.room(frame.chunks * kChunk);
    frame.rows.room(frame.chunks * kChunk);
    frame.place_first.room(frame.chunks * kChunk);
    frame.chunk_count.room(frame.chunks);
    frame.chunk_places.room(frame.chunks);
    frame.num_bands = (frame.blocks_y + kBandRows - 1) / kBandRows;
    frame.chunk_bands.room(frame.chunks * frame.num_bands);
    if ((int)frame.bands.size() < frame.num_bands) frame.bands.resize(frame.num_bands);
    for (int b = 0; b < frame.num_bands; ++b) {
        frame.bands[b].top = b * kBandRows;
        frame.bands[b].rows = std::min(kBandRows, frame.blocks_y - frame.bands[b].top);
    }
}

}  // namespace binning
