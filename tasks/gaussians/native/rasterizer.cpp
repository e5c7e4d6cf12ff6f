// Differentiable rasterizer of 3D Gaussians (3D Gaussian Splatting, Kerbl et al. 2023, Sec. 4-6; EWA splatting,
// Zwicker et al. 2001). One thread a call, no global state: any number of calls may run side by side.

#include <exception>
#include <memory>
#include <vector>

#include "binning.h"
#include "lanes.h"

namespace {

using binning::Frame;
using binning::Splat;
using lanes::I16;
using lanes::splat;
using lanes::V16;
using lanes::where_less;

constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kDead = -1e9f;  // added to the exponent of a lane that takes nothing more

alignas(64) constexpr float kColumn[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) constexpr float kRow[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

struct Block {
    int x, y, width, height;  // of the image, and the block's first pixel
    Block(const Scene& s, const Frame& frame, int64_t index)
        : x(4 * (int)(index % frame.blocks_x)), y(4 * (int)(index / frame.blocks_x)), width(s.width), height(s.height) {}

    template <class F>
    void pixels(F visit) const {
        for (int r = 0; r < 4 && y + r < height; ++r)
            for (int c = 0; c < 4 && x + c < width; ++c) visit(4 * r + c, (int64_t)(y + r) * width + x + c);
    }
    V16 gather(const float* image, int stride = 1, int channel = 0) const {
        alignas(64) float lane[16] = {};
        if (image) pixels([&](int k, int64_t p) { lane[k] = image[p * stride + channel]; });
        return lanes::load(lane);
    }
    void scatter(const V16& v, float* image, int stride = 1, int channel = 0) const {
        alignas(64) float lane[16];
        lanes::store(lane, v);
        pixels([&](int k, int64_t p) { image[p * stride + channel] = lane[k]; });
    }
    V16 outside() const {  // kDead in the lanes beyond the border of the image
        alignas(64) float lane[16];
        for (float& v : lane) v = kDead;
        pixels([&](int k, int64_t) { lane[k] = 0; });
        return lanes::load(lane);
    }
};

// The state of front-to-back blending in the 16 pixels of a block, the same in both directions.
struct Blend {
    V16 column, row, dead, T;

    Blend(const Block& b) {
        column = lanes::load(kColumn) + (b.x + 0.5f);
        row = lanes::load(kRow) + (b.y + 0.5f);
        dead = b.outside();
        T = splat(1.0f);
    }
    struct Step {
        V16 dx, dy, raw, alpha, weight, before;  // raw: alpha before its cut at 0.99; before: T in front
    };
    INLINE Step over(Blend& s, const Splat& p) {
        Step step;
        step.dx = s.column - p.u;
        step.dy = s.row - p.v;
        const V16 exponent =
            step.dx * (step.dx * p.A + step.dy * p.B) + step.dy * step.dy * p.C + (s.dead + p.log2_opacity);
        step.raw = lanes::exp2_lanes(lanes::maximum(exponent, splat(-100.0f)));
        V16 alpha = lanes::minimum(step.raw, splat(kMaxAlpha));
        alpha = where_less(alpha, splat(projection::kMinAlpha), splat(0.0f), alpha);
        const V16 after = s.T - s.T * alpha, limit = splat(kMinTransmittance);
        step.alpha = where_less(after, limit, splat(0.0f), alpha);
        s.dead = where_less(after, limit, splat(kDead), s.dead);
        step.before = s.T;
        step.weight = s.T * step.alpha;
        s.T = where_less(after, limit, s.T, after);
        return step;
    }
    bool finished() const {
        alignas(64) float lane[16];
        lanes::store(lane, dead);
        float most = lane[0];
        for (float v : lane) most = v > most ? v : most;
        return most < 0;
    }
};

// The label masks' channels that occur in the block at hand, as a compact list.
class LabelSlots {
  public:
    explicit LabelSlots(int num_labels) : slot_of_(num_labels, -1), slots_(num_labels) {}

    // The block's value for a label; what `first_value` gives when the label is new to the block.
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

// A block stops when all its pixels are done; asking costs, so it is asked once in so many entries.
constexpr int64_t kAskEvery = 16;

template <bool kLabels, bool kWinners>
void blend_forward(const Scene& s, const Frame& frame, const Images& out) {
    const int64_t pixels = (int64_t)s.width * s.height;
    LabelSlots slots(s.num_labels);
    for (int64_t index = 0; index + 1 < (int64_t)frame.first.size(); ++index) {
        const Block block(s, frame, index);
        Blend state(block);
        V16 red = splat(0), green = splat(0), blue = splat(0), depth = splat(0), best = splat(0);
        I16 winner = lanes::splat_int(-1);
        for (int64_t e = frame.first[index]; e < frame.first[index + 1]; ++e) {
            const Splat& p = frame.splats[frame.entries[e]];
            const Blend::Step step = Blend::over(state, p);
            red = red + step.weight * p.color[0];
            green = green + step.weight * p.color[1];
            blue = blue + step.weight * p.color[2];
            depth = depth + step.weight * p.z;
            if (kLabels && p.label >= 0) {
                V16& sum = slots.at(p.label, [] { return splat(0); });
                sum = sum + step.weight;
            }
            if (kWinners) {
                winner = where_less(best, step.weight, lanes::splat_int(p.row), winner);
                best = lanes::maximum(best, step.weight);
                float& strongest = out.strongest[p.row];
                strongest = std::fmax(strongest, lanes::largest(step.weight));
            }
            if ((e - frame.first[index]) % kAskEvery == kAskEvery - 1 && state.finished()) break;
        }
        block.scatter(red + state.T * s.background[0], out.rgb, 3, 0);
        block.scatter(green + state.T * s.background[1], out.rgb, 3, 1);
        block.scatter(blue + state.T * s.background[2], out.rgb, 3, 2);
        block.scatter(1.0f - state.T, out.alpha);
        block.scatter(depth, out.depth);
        slots.drain([&](int label, const V16& v) { block.scatter(v, out.masks + label * pixels); });
        if (kWinners) {
            int32_t lane[16];
            __builtin_memcpy(lane, &winner, sizeof lane);
            block.pixels([&](int k, int64_t p) { out.top[p] = lane[k]; });
        }
    }
}

// Ten sums for each splat: moments 1, x, y, xx, xy, yy of dL/d(log alpha); dL/d(color); dL/dz.
struct alignas(64) Sums {
    float value[16];
};

// Front to back, like the forward pass. What lies behind an entry is the total, known from the images, less what has
// been passed, so nothing but the images has to be kept.
template <bool kLabels>
void blend_backward(const Scene& s, const Frame& frame, const Images& image, const Images& grad,
                    std::vector<Sums>& sums, float* background) {
    const int64_t pixels = (int64_t)s.width * s.height;
    LabelSlots slots(s.num_labels);
    V16 towards_background[3] = {splat(0), splat(0), splat(0)};
    for (int64_t index = 0; index + 1 < (int64_t)frame.first.size(); ++index) {
        const Block block(s, frame, index);
        Blend state(block);
        V16 g[3], behind = splat(0);
        const V16 alpha = block.gather(image.alpha), g_alpha = block.gather(grad.alpha);
        const V16 g_depth = block.gather(grad.depth);
        for (int c = 0; c < 3; ++c) {
            g[c] = block.gather(grad.rgb, 3, c);
            behind = behind + g[c] * block.gather(image.rgb, 3, c);
            towards_background[c] = towards_background[c] + g[c] * (1.0f - alpha);
        }
        behind = behind + g_alpha * alpha + g_depth * block.gather(image.depth);
        if (kLabels)
            for (int label = 0; label < s.num_labels; ++label)
                behind = behind + block.gather(grad.masks + label * pixels) *
                                      block.gather(image.masks + label * pixels);
        for (int64_t e = frame.first[index]; e < frame.first[index + 1]; ++e) {
            const int32_t rank = frame.entries[e];
            const Splat& p = frame.splats[rank];
            const Blend::Step step = Blend::over(state, p);
            V16 value = g[0] * p.color[0] + g[1] * p.color[1] + g[2] * p.color[2] + g_depth * p.z + g_alpha;
            if (kLabels && p.label >= 0)
                value = value + slots.at(p.label, [&] { return block.gather(grad.masks + p.label * pixels); });
            behind = behind - step.weight * value;
            V16 d = (step.before * value - behind / (1.0f - step.alpha)) * step.alpha;
            d = where_less(splat(kMaxAlpha), step.raw, splat(0), d);
            const V16 dx = d * step.dx, dy = d * step.dy;
            const V16 v[10] = {d,
                               dx,
                               dy,
                               dx * step.dx,
                               dx * step.dy,
                               dy * step.dy,
                               step.weight * g[0],
                               step.weight * g[1],
                               step.weight * g[2],
                               step.weight * g_depth};
            lanes::add_sums(v, sums[rank].value);
            if ((e - frame.first[index]) % kAskEvery == kAskEvery - 1 && state.finished()) break;
        }
        slots.drain([](int, const V16&) {});
    }
    for (int c = 0; c < 3; ++c) {
        alignas(64) float lane[16];
        lanes::store(lane, towards_background[c]);
        for (float v : lane) background[c] += v;
    }
}

}  // namespace

extern "C" {

// Renders; the images and per-Gaussian arrays are the caller's, masks and strongest zeroed. Returns what
// `ss_rasterize_backward` needs, to be given back with `ss_rasterize_release`; null when memory is out.
void* ss_rasterize(const Scene* scene, const Images* out) {
    try {
        std::unique_ptr<Frame> frame(new Frame);
        binning::bin(*scene, out->radii, *frame);
        const bool labels = scene->labels && scene->num_labels > 0;
        if (out->top)
            (labels ? blend_forward<true, true> : blend_forward<false, true>)(*scene, *frame, *out);
        else
            (labels ? blend_forward<true, false> : blend_forward<false, false>)(*scene, *frame, *out);
        return frame.release();
    } catch (const std::exception&) {
        return nullptr;
    }
}

// Writes the gradients of the Gaussians in view into zeroed arrays. 0 = done, 1 = out of memory.
int ss_rasterize_backward(const void* kept, const Scene* scene, const Images* images, const Images* towards_images,
                          const Gradients* out) {
    try {
        const Frame& frame = *static_cast<const Frame*>(kept);
        std::vector<Sums> sums(frame.splats.size());
        const bool labels = scene->labels && scene->num_labels > 0 && towards_images->masks;
        (labels ? blend_backward<true> : blend_backward<false>)(*scene, frame, *images, *towards_images, sums,
                                                                out->background);
        const projection::View view = projection::view_of(*scene);
        projection::Footprint f;
        for (size_t rank = 0; rank < sums.size(); ++rank) {
            const float* v = sums[rank].value;
            const int64_t row = frame.splats[rank].row;
            projection::project(*scene, view, row, f);
            const projection::ScreenGradient g = {v[0], v[1], v[2], v[3], v[4], v[5], {v[6], v[7], v[8]}, v[9]};
            projection::backproject(*scene, view, row, f, g, *out);
        }
        return 0;
    } catch (const std::exception&) {
        return 1;
    }
}

void ss_rasterize_release(void* kept) { delete static_cast<Frame*>(kept); }
}
