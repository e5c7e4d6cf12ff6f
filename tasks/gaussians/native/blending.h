// Front-to-back blending of the splats of each 4x4-pixel block, and its gradient: sixteen pixels, one in each lane.
#pragma once

#include "binning.h"

namespace blending {

using binning::Band;
using binning::Frame;
using binning::Splat;
using binning::Sums;
using lanes::I16;
using lanes::splat;
using lanes::V16;
using lanes::where_less;

constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;

alignas(64) constexpr float kColumn[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kRow[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

struct Block {
    int x, y, width, height;  // its first pixel, and the image
    bool whole;
    Block(const Scene& s, const Frame& frame, const Band& band, int index)
        : x(4 * (index % frame.blocks_x)), y(4 * (band.top + index / frame.blocks_x)), width(s.width), height(s.height),
          whole(x + 4 <= width && y + 4 <= height) {}

    template <class F>
    void pixels(F visit) const {
        if (whole) {  // apart, since loops of known length become vector code
            for (int r = 0; r < 4; ++r)
                for (int c = 0; c < 4; ++c) visit(4 * r + c, (int64_t)(y + r) * width + x + c);
            return;
        }
        for (int r = 0; r < 4 && y + r < height; ++r)
            for (int c = 0; c < 4 && x + c < width; ++c) visit(4 * r + c, (int64_t)(y + r) * width + x + c);
    }
    V16 gather(const float* image) const {  // null gives zeros
        alignas(64) float lane[16] = {};
        if (image && whole)
            for (int r = 0; r < 4; ++r) std::memcpy(lane + 4 * r, image + (int64_t)(y + r) * width + x, 16);
        else if (image)
            pixels([&](int k, int64_t p) { lane[k] = image[p]; });
        return lanes::load(lane);
    }
    void gather3(const float* image, V16 (&out)[3]) const {
        alignas(64) float lane[3][16] = {};
        if (image)
            pixels([&](int k, int64_t p) {
                for (int c = 0; c < 3; ++c) lane[c][k] = image[3 * p + c];
            });
        for (int c = 0; c < 3; ++c) out[c] = lanes::load(lane[c]);
    }
    void scatter(const V16& v, float* image) const {
        alignas(64) float lane[16];
        lanes::store(lane, v);
        if (whole)
            for (int r = 0; r < 4; ++r) std::memcpy(image + (int64_t)(y + r) * width + x, lane + 4 * r, 16);
        else
            pixels([&](int k, int64_t p) { image[p] = lane[k]; });
    }
    void scatter3(const V16 (&v)[3], float* image) const {
        alignas(64) float lane[3][16];
        for (int c = 0; c < 3; ++c) lanes::store(lane[c], v[c]);
        pixels([&](int k, int64_t p) {
            for (int c = 0; c < 3; ++c) image[3 * p + c] = lane[c][k];
        });
    }
    V16 inside() const {  // 1 in the image, 0 beyond its border
        alignas(64) float lane[16] = {};
        pixels([&](int k, int64_t) { lane[k] = 1; });
        return lanes::load(lane);
    }
    I16 gather_ids(const int32_t* ids) const {
        alignas(64) int32_t lane[16] = {};
        pixels([&](int k, int64_t p) { lane[k] = ids[p]; });
        I16 v;
        std::memcpy(&v, lane, sizeof v);
        return v;
    }
};

// One splat over the block's pixels.
struct Touch {
    V16 raw, alpha;  // before and after the cuts at 0.99 and 1/255
    INLINE Touch of(const V16& column, const V16& row, const Splat& p) {
        const V16 dy = row - p.v, x = (column - p.u) + dy * p.shear;
        const V16 exponent = x * (x * p.A) + (dy * dy * p.C + p.log2_opacity);
        Touch t;
        t.raw = lanes::exp2_lanes(exponent);
        t.alpha = where_less(exponent, splat(projection::kLog2MinAlpha), splat(0),
                             lanes::minimum_of_positive(t.raw, splat(kMaxAlpha)));
        return t;
    }
};

// A splat's weight in each pixel; T is what is left for those behind. A pixel that is done lets nothing through any more,
// so it stays done.
INLINE V16 weight_of(const V16& alpha, V16& T) {
    const V16 after = T * (1.0f - alpha);
    const V16 weight = where_less(after, splat(kMinTransmittance), splat(0), T * alpha);
    T = where_less(after, splat(kMinTransmittance), splat(0), after);
    return weight;
}

// What `mismatch` counts the weights of a label with: -1 where the pixel should show it, 1 elsewhere.
INLINE V16 sign_of(int32_t label, const I16& ids) { return lanes::where_equal(ids, label, splat(-1), splat(1)); }

// A value for each of the labels that occur in the block at hand.
class LabelSlots {
  public:
    explicit LabelSlots(int num_labels) : slot_of_(num_labels, -1), slots_(num_labels) {}

    // The label's value; what `first_value` gives when the label is new to the block.
    template <class F>
    V16& at(int label, F first_value) {
        if (slot_of_[label] < 0) {
            slot_of_[label] = (int)labels_.size();
            slots_[labels_.size()].value = first_value();
            labels_.push_back(label);
        }
        return slots_[slot_of_[label]].value;
    }
    template <class F>
    void drain(F visit) {
        for (size_t k = 0; k < labels_.size(); ++k) {
            visit(labels_[k], slots_[k].value);
            slot_of_[labels_[k]] = -1;
        }
        labels_.clear();
    }

  private:
    struct Slot {
        V16 value;
    };
    std::vector<int> slot_of_, labels_;
    std::vector<Slot> slots_;
};

enum class Labels { none, masks, mismatch };

// A block ends when all its pixels are opaque; asking costs, so it is asked once in so many entries.
constexpr int kAskEvery = 16;

template <Labels kLabels, bool kWinners>
void forward(const Scene& s, const Frame& frame, Band& band, const Images& out) {
    const int64_t pixels = (int64_t)s.width * s.height;
    LabelSlots masks(kLabels == Labels::masks ? s.num_labels : 0);
    float* strongest = kWinners ? band.strongest.room(band.count) : nullptr;
    if (kWinners) std::fill(strongest, strongest + band.count, 0.0f);
    const int blocks = band.rows * frame.blocks_x;
    band.used.room(blocks);
    for (int index = 0; index < blocks; ++index) {
        const Block block(s, frame, band, index);
        const V16 column = lanes::load(kColumn) + (block.x + 0.5f), row = lanes::load(kRow) + (block.y + 0.5f);
        V16 T = block.whole ? splat(1) : block.inside();
        V16 red = splat(0), green = splat(0), blue = splat(0), depth = splat(0), alpha = splat(0), best = splat(0);
        V16 mismatch = splat(0);
        I16 ids = lanes::splat_int(0);
        if (kLabels == Labels::mismatch) ids = block.gather_ids(s.ids);
        I16 winner = lanes::splat_int(-1);
        const int32_t* entries = band.entries.data() + band.first[index];
        const int count = (int)(band.end[index] - band.first[index]);
        int e = 0;
        while (e < count) {
            for (const int end = std::min(e + kAskEvery, count); e < end; ++e) {
                __builtin_prefetch(&band.splats[entries[e + binning::kAhead]]);
                const Splat& p = band.splats[entries[e]];
                const V16 weight = weight_of(Touch::of(column, row, p).alpha, T);
                red = red + weight * p.color[0];
                green = green + weight * p.color[1];
                blue = blue + weight * p.color[2];
                depth = depth + weight * p.z;
                alpha = alpha + weight;
                if (kLabels == Labels::masks && p.label >= 0) {
                    V16& sum = masks.at(p.label, [] { return splat(0); });
                    sum = sum + weight;
                }
                if (kLabels == Labels::mismatch && p.label >= 0)
                    mismatch = mismatch + weight * sign_of(p.label, ids);
                if (kWinners) {
                    winner = where_less(best, weight, lanes::splat_int(p.row), winner);
                    best = lanes::maximum(best, weight);
                    float& most = strongest[entries[e]];
                    most = std::fmax(most, lanes::largest(weight));
                }
            }
            if (lanes::largest(T) == 0) break;
        }
        band.used[index] = e;
        const V16 rest = 1.0f - alpha;
        block.scatter3({red + rest * s.background[0], green + rest * s.background[1], blue + rest * s.background[2]},
                       out.rgb);
        block.scatter(alpha, out.alpha);
        block.scatter(depth, out.depth);
        masks.drain([&](int label, const V16& v) { block.scatter(v, out.masks + label * pixels); });
        if (kLabels == Labels::mismatch) block.scatter(mismatch, out.mismatch);
        if (kWinners) {
            int32_t lane[16];
            std::memcpy(lane, &winner, sizeof lane);
            block.pixels([&](int k, int64_t p) { out.top[p] = lane[k]; });
        }
    }
}

// Sixteen entries' gradients, lane by lane, until there are enough to sum them over the lanes together: transposed,
// an entry lies in each lane.
class Harvest {
  public:
    // Begins a block; the one before must have been flushed.
    void begin(const V16 (&towards)[4], const V16& column, const V16& row) {
        for (int c = 0; c < 4; ++c) lanes::store(towards_[c], towards[c]);
        float lane[16];
        lanes::store(lane, column), x_ = lane[0];
        lanes::store(lane, row), y_ = lane[0];
    }
    // d: dL/d(log alpha).
    INLINE void add(Harvest& h, int32_t number, const Splat& p, const V16& d, const V16& weight, Sums* sums) {
        lanes::store(h.d_[h.count_], d);
        lanes::store(h.weight_[h.count_], weight);
        h.dx_[h.count_] = h.x_ - p.u, h.dy_[h.count_] = h.y_ - p.v, h.shear_[h.count_] = p.shear;
        h.number_[h.count_] = number;
        if (++h.count_ == 16) h.flush(sums);
    }
    void flush(Sums* sums) {
        if (count_ == 0) return;
        V16 out[16], v[16];
        for (int k = 0; k < 16; ++k) v[k] = lanes::load(weight_[k]);
        lanes::transpose(v);
        for (int c = 0; c < 4; ++c) {
            out[6 + c] = v[0] * towards_[c][0];
            for (int k = 1; k < 16; ++k) out[6 + c] = out[6 + c] + v[k] * towards_[c][k];
        }
        for (int k = 0; k < 16; ++k) v[k] = lanes::load(d_[k]);
        lanes::transpose(v);
        // Moments about the block's first pixel from the sums of rows and columns, then sheared, then about the splat's
        // mean.
        V16 row[4], along[4], m = splat(0), mx = splat(0), mxx = splat(0);
        for (int r = 0; r < 4; ++r) {
            row[r] = (v[4 * r] + v[4 * r + 1]) + (v[4 * r + 2] + v[4 * r + 3]);
            along[r] = v[4 * r + 1] + 2.0f * v[4 * r + 2] + 3.0f * v[4 * r + 3];
            mxx = mxx + (v[4 * r + 1] + 4.0f * v[4 * r + 2] + 9.0f * v[4 * r + 3]);
        }
        m = (row[0] + row[1]) + (row[2] + row[3]);
        mx = (along[0] + along[1]) + (along[2] + along[3]);
        const V16 my = row[1] + 2.0f * row[2] + 3.0f * row[3], myy = row[1] + 4.0f * row[2] + 9.0f * row[3];
        const V16 mxy = along[1] + 2.0f * along[2] + 3.0f * along[3];
        const V16 shear = lanes::load(shear_), dy = lanes::load(dy_), x = lanes::load(dx_) + shear * dy;
        const V16 sx = mx + shear * my, sxy = mxy + shear * myy, sxx = mxx + shear * (mxy + sxy);
        out[0] = m;
        out[1] = sx + x * m;
        out[2] = my + dy * m;
        out[3] = sxx + x * (sx + out[1]);
        out[4] = sxy + x * my + dy * out[1];
        out[5] = myy + dy * (my + out[2]);
        for (int k = 10; k < 16; ++k) out[k] = splat(0);
        lanes::transpose(out);
        for (int k = 0; k < count_; ++k) {
            float* to = sums[number_[k]].value;
            lanes::store(to, lanes::load(to) + out[k]);
        }
        count_ = 0;
    }

  private:
    alignas(64) float d_[16][16] = {}, weight_[16][16] = {};
    alignas(64) float towards_[4][16], dx_[16] = {}, dy_[16] = {}, shear_[16] = {};
    int32_t number_[16];
    float x_, y_;
    int count_ = 0;
};

// Front to back, like the forward pass. What lies behind an entry is the total, known from the images, less what has
// been passed, so nothing but the images has to be kept.
template <Labels kLabels>
void backward(const Scene& s, const Frame& frame, Band& band, const Images& image, const Images& grad,
              float (&background)[3]) {
    const int64_t pixels = (int64_t)s.width * s.height;
    LabelSlots masks(kLabels == Labels::masks ? s.num_labels : 0);
    Sums* sums = band.sums.room(band.count);
    std::fill(sums, sums + band.count, Sums{});
    V16 towards_background[3] = {splat(0), splat(0), splat(0)};
    Harvest harvest;
    for (int index = 0; index < band.rows * frame.blocks_x; ++index) {
        const Block block(s, frame, band, index);
        const V16 column = lanes::load(kColumn) + (block.x + 0.5f), row = lanes::load(kRow) + (block.y + 0.5f);
        V16 T = block.whole ? splat(1) : block.inside();
        V16 g[3], rgb[3], contrast = splat(0);
        I16 ids = lanes::splat_int(0);
        const V16 alpha = block.gather(image.alpha), g_alpha = block.gather(grad.alpha);
        const V16 g_depth = block.gather(grad.depth);
        block.gather3(grad.rgb, g), block.gather3(image.rgb, rgb);
        V16 behind = g_alpha * alpha + g_depth * block.gather(image.depth);
        for (int c = 0; c < 3; ++c) {
            behind = behind + g[c] * rgb[c];
            towards_background[c] = towards_background[c] + g[c] * (1.0f - alpha);
        }
        if (kLabels == Labels::masks)
            for (int label = 0; label < s.num_labels; ++label)
                behind = behind + block.gather(grad.masks + label * pixels) * block.gather(image.masks + label * pixels);
        if (kLabels == Labels::mismatch) {
            contrast = block.gather(grad.mismatch);
            ids = block.gather_ids(s.ids);
            behind = behind + contrast * block.gather(image.mismatch);
        }
        harvest.begin({g[0], g[1], g[2], g_depth}, column, row);
        const int32_t* entries = band.entries.data() + band.first[index];
        const int used = band.used[index];
        for (int e = 0; e < used; ++e) {
            __builtin_prefetch(&band.splats[entries[e + binning::kAhead]]);
            __builtin_prefetch(&sums[entries[e + binning::kAhead]], 1);
            const Splat& p = band.splats[entries[e]];
            const Touch t = Touch::of(column, row, p);
            const V16 through = 1.0f - t.alpha, after = T * through;
            const V16 counted = where_less(after, splat(kMinTransmittance), splat(0), t.alpha);
            const V16 weight = T * counted;
            T = where_less(after, splat(kMinTransmittance), splat(0), after);
            V16 value = g[0] * p.color[0] + g[1] * p.color[1] + g[2] * p.color[2] + (g_depth * p.z + g_alpha);
            if (kLabels == Labels::masks && p.label >= 0)
                value = value + masks.at(p.label, [&] { return block.gather(grad.masks + p.label * pixels); });
            if (kLabels == Labels::mismatch && p.label >= 0)
                value = value + contrast * sign_of(p.label, ids);
            const V16 gain = weight * value;
            behind = behind - gain;
            const V16 d = where_less(splat(kMaxAlpha), t.raw, splat(0), gain - behind * (counted / through));
            Harvest::add(harvest, entries[e], p, d, weight, sums);
        }
        harvest.flush(sums);
        masks.drain([](int, const V16&) {});
    }
    for (int c = 0; c < 3; ++c) {
        alignas(64) float lane[16];
        lanes::store(lane, towards_background[c]);
        background[c] = 0;
        for (float v : lane) background[c] += v;
    }
}

// Adds up each splat's weights in the pixels of each id >= 0: the weights of the forward pass once more.
inline void weigh(const Scene& s, const Frame& frame, Band& band, const int32_t* ids) {
    int32_t* first = band.first_share.room(band.count);
    std::fill(first, first + band.count, -1);
    band.shares.clear();
    const auto add = [&](int32_t number, int32_t id, float weight) {
        int32_t* at = &first[number];
        while (*at >= 0 && band.shares[*at].id != id) at = &band.shares[*at].next;
        if (*at >= 0) {
            band.shares[*at].weight += weight;
        } else {
            *at = (int32_t)band.shares.size();  // before the vector moves
            band.shares.push_back({number, id, -1, weight});
        }
    };
    for (int index = 0; index < band.rows * frame.blocks_x; ++index) {
        const Block block(s, frame, band, index);
        const I16 shown = block.gather_ids(ids);
        int32_t known[16];
        V16 of[16];
        int count = 0;
        block.pixels([&](int, int64_t p) {
            if (ids[p] < 0 || std::find(known, known + count, ids[p]) != known + count) return;
            known[count] = ids[p];
            of[count++] = lanes::where_equal(shown, ids[p], splat(1), splat(0));
        });
        if (!count) continue;
        const V16 column = lanes::load(kColumn) + (block.x + 0.5f), row = lanes::load(kRow) + (block.y + 0.5f);
        V16 T = block.whole ? splat(1) : block.inside();
        const int32_t* entries = band.entries.data() + band.first[index];
        for (int e = 0; e < band.used[index]; ++e) {
            __builtin_prefetch(&band.splats[entries[e + binning::kAhead]]);
            const V16 weight = weight_of(Touch::of(column, row, band.splats[entries[e]]).alpha, T);
            for (int k = 0; k < count; ++k)
                if (const float sum = lanes::sum(weight * of[k]); sum > 0) add(entries[e], known[k], sum);
        }
    }
}

}  // namespace blending
