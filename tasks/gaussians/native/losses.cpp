// L1 + SSIM of two images with its gradient, the losses of alpha, depth and labels, and Adam. Rows are worked on in
// pieces of a fixed size, whose sums are added in their order: the number of threads changes no byte.

#include <cmath>

#include "lanes.h"
#include "workspace.h"

namespace {

using namespace lanes;

constexpr int kRadius = 5;  // an 11 x 11 window, sigma 1.5 (Wang et al. 2004)
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr int kPiece = 16;  // rows
constexpr int kLanes = sizeof(Register) / sizeof(float), kTogether = 16;

struct Window {
    float tap[kRadius + 1];
    Window() {
        double sum = 0;
        for (int k = -kRadius; k <= kRadius; ++k) sum += std::exp(-k * k / 4.5);
        for (int k = 0; k <= kRadius; ++k) tap[k] = (float)(std::exp(-k * k / 4.5) / sum);
    }
};

// A line of n with room for the window beyond both ends, where it is zero, and for a whole register.
struct Line {
    Line(int n, int pad) : n(n), pad(pad), values(n + 2 * pad + kLanes, 0.0f), middle(values.data() + pad) {}
    void end() { std::fill(middle + n, middle + n + pad, 0.0f); }
    int n, pad;
    std::vector<float> values;
    float* middle;
};

// to[i] = t0 * at[i] + t1 * (at[i - step] + at[i + step]) + ..., for n elements. The taps are values, so that no store
// can change them and the loop becomes vector code.
void convolve(int n, int step, const Window& w, const float* __restrict at, float* __restrict to) {
    const float t0 = w.tap[0], t1 = w.tap[1], t2 = w.tap[2], t3 = w.tap[3], t4 = w.tap[4], t5 = w.tap[5];
    for (int i = 0; i < n; ++i)
        to[i] = t0 * at[i] + t1 * (at[i - step] + at[i + step]) + t2 * (at[i - 2 * step] + at[i + 2 * step]) +
                t3 * (at[i - 3 * step] + at[i + 3 * step]) + t4 * (at[i - 4 * step] + at[i + 4 * step]) +
                t5 * (at[i - 5 * step] + at[i + 5 * step]);
}

// The window's rows above and below row y that lie in the image.
template <class F>
void each_tap(int y, int height, const Window& w, F visit) {
    for (int k = std::max(-kRadius, -y); k <= std::min(kRadius, height - 1 - y); ++k) visit(y + k, w.tap[std::abs(k)]);
}

Register read(const float* at) { return Memory<Register>::load(at); }

// From `by` elements before a part of a row of n to as many behind it. It begins at a multiple of what `Sum` and every
// register hold, so that each element has the bytes that it would have in the whole row.
Part widened(Part part, int by, int n) {
    return {std::max(part.begin - by, 0) / kTogether * kTogether, std::min(part.end + by, n)};
}

// Down the columns around row y of images of `height` rows of n, in a part of the row: each line gets one of the sums
// that `add(at, tap, sums)` adds to, for a register of elements from `at` on; what lies beyond the end of a row is read,
// and counts nowhere.
template <int count, class F>
void convolve_columns(Part part, int y, int n, int height, const Window& w, Line (&to)[count], F add) {
    for (int i = part.begin; i < part.end; i += kLanes) {
        Register sums[count] = {};
        each_tap(y, height, w, [&](int row, float tap) { add((int64_t)row * n + i, tap, sums); });
        for (int k = 0; k < count; ++k) Memory<Register>::store(to[k].middle + i, sums[k]);
    }
    for (Line& line : to) line.end();
}

// Per pixel s = (a1 a2) / (b1 b2) from the blurred x, y, xx, yy, xy. mx, mxx, mxy become the gradients of
// -sum(share * s) towards themselves, my the pixels' shares * s.
void compare(int n, const float* __restrict share, const float* __restrict mx, float* __restrict my,
             const float* __restrict mxx, const float* __restrict myy, const float* __restrict mxy,
             float* __restrict towards_mean, float* __restrict towards_square, float* __restrict towards_product) {
    for (int i = 0; i < n; ++i) {
        const float u = mx[i], v = my[i];
        const float b1 = u * u + v * v + kC1, b2 = (mxx[i] - u * u) + (myy[i] - v * v) + kC2;
        const float a1 = 2 * u * v + kC1, a2 = 2 * (mxy[i] - u * v) + kC2;
        const float inverse = 1 / (b1 * b2), s = a1 * a2 * inverse, g = -share[i];
        my[i] = share[i] * s;
        towards_mean[i] = g * (2 * v * (a2 - a1) * inverse - 2 * u * s * inverse * (b2 - b1));
        towards_square[i] = -g * s * b1 * inverse;
        towards_product[i] = g * 2 * a1 * inverse;
    }
}

// Of n values: both images where the share is above 0, what each adds to L1, and the gradient of that, times `weight`.
void differ(int n, float weight, const float* __restrict share, const float* __restrict image,
            const float* __restrict target, float* __restrict x, float* __restrict y, float* __restrict terms,
            float* __restrict gradient) {
    for (int i = 0; i < n; ++i) {
        x[i] = share[i] > 0 ? image[i] : 0, y[i] = share[i] > 0 ? target[i] : 0;
        const float d = x[i] - y[i];
        terms[i] = share[i] * std::fabs(d);
        gradient[i] = weight * share[i] * (float)((d > 0) - (d < 0));
    }
}

struct Sum {  // of many floats: sixteen running sums, added at the end
    float lane[kTogether] = {};
    double total = 0;
    void add(const float* values, int n) {
        int i = 0;
        for (; i + kTogether <= n; i += kTogether)
            for (int k = 0; k < kTogether; ++k) lane[k] += values[i + k];
        for (; i < n; ++i) lane[i % kTogether] += values[i];
        for (float& v : lane) total += v, v = 0;
    }
};

}  // namespace

extern "C" {

// Colour loss over the pixels of weight > 0; images are [height, width, channels], weight is [height, width]. Writes
// its gradient towards the image, and {loss, L1, SSIM} to `out`. 0 = done, 1 = out of memory.
int ss_photometric(void* workspace, int width, int height, int channels, const float* image, const float* target,
                   const float* weight, float ssim_weight, float* gradient, double* out, int threads) {
    return guarded([&] {
        auto& loss = static_cast<Workspace*>(workspace)->loss;
        const int n = width * channels, pieces = (height + kPiece - 1) / kPiece;
        const int64_t size = (int64_t)n * height;
        const int64_t wide = size + kLanes;  // the last row is read in whole registers
        float *share = loss.share.room(size), *x = loss.x.room(wide), *y = loss.y.room(wide);
        float *mean = loss.towards_mean.room(wide), *square = loss.towards_square.room(wide);
        float* product = loss.towards_product.room(wide);
        Part* counted = loss.counted.room(height);  // what of each row counts at most; SSIM is asked for nowhere else
        double* sums = loss.sums.room(2 * pieces);
        Sum weights;
        for (int r = 0; r < height; ++r) weights.add(weight + (int64_t)r * width, width);
        if (!(weights.total > 0)) {
            std::fill(gradient, gradient + size, 0.0f);
            out[0] = out[1] = 0, out[2] = 1;
            return;
        }
        const float norm = (float)(1 / (weights.total * channels));
        const auto rows = [&](int64_t piece, auto visit) {
            for (int r = (int)piece * kPiece; r < std::min(height, ((int)piece + 1) * kPiece); ++r) visit(r, (int64_t)r * n);
        };

        parallel::each(threads, pieces, [&](int64_t piece) {
            std::vector<float> terms(n);
            Sum l1;
            rows(piece, [&](int r, int64_t at) {
                const float* of_row = weight + (int64_t)r * width;
                int first = 0, end = width;
                while (first < end && !(of_row[first] > 0)) ++first;
                while (first < end && !(of_row[end - 1] > 0)) --end;
                counted[r] = widened({first * channels, end * channels}, 0, n);
                for (int p = 0; p < width; ++p)
                    for (int c = 0; c < channels; ++c) share[at + p * channels + c] = of_row[p] * norm;
                differ(n, 1 - ssim_weight, share + at, image + at, target + at, x + at, y + at, terms.data(),
                       gradient + at);
                l1.add(terms.data(), n);
            });
            sums[2 * piece] = l1.total, sums[2 * piece + 1] = 0;
        });

        if (ssim_weight > 0) {
            const Window w;
            parallel::each(threads, pieces, [&](int64_t piece) {
                const int pad = kRadius * channels;
                Line down[5] = {{n, pad}, {n, pad}, {n, pad}, {n, pad}, {n, pad}};
                std::vector<float> blurred(5 * (size_t)n);
                float* m[5];
                for (int k = 0; k < 5; ++k) m[k] = blurred.data() + (size_t)k * n;
                Sum ssim;
                rows(piece, [&](int r, int64_t at) {
                    for (float* towards : {mean, square, product}) std::fill(towards + at, towards + at + n, 0.0f);
                    const Part part = counted[r], around = widened(part, pad, n);
                    const int b = part.begin, some = part.end - part.begin;
                    if (some <= 0) return;
                    convolve_columns(around, r, n, height, w, down, [&](int64_t from, float tap, Register(&sums)[5]) {
                        const Register u = read(x + from), v = read(y + from), a = tap * u, b = tap * v;
                        sums[0] = sums[0] + a, sums[1] = sums[1] + b;
                        sums[2] = sums[2] + a * u, sums[3] = sums[3] + b * v, sums[4] = sums[4] + a * v;
                    });
                    for (int k = 0; k < 5; ++k) convolve(some, channels, w, down[k].middle + b, m[k]);
                    compare(some, share + at + b, m[0], m[1], m[2], m[3], m[4], mean + at + b, square + at + b,
                            product + at + b);
                    ssim.add(m[1], some);
                });
                sums[2 * piece + 1] = ssim.total;
            });
            // The blur is symmetric, so it carries the gradient back as well.
            parallel::each(threads, pieces, [&](int64_t piece) {
                const int pad = kRadius * channels;
                Line down[3] = {{n, pad}, {n, pad}, {n, pad}};
                std::vector<float> blurred(3 * (size_t)n);
                float *m = blurred.data(), *s = m + n, *p = s + n;
                rows(piece, [&](int r, int64_t at) {
                    const Part part = counted[r], around = widened(part, pad, n);
                    const int some = part.end - part.begin;
                    if (some <= 0) return;
                    convolve_columns(around, r, n, height, w, down, [&](int64_t from, float tap, Register(&sums)[3]) {
                        sums[0] = sums[0] + tap * read(mean + from);
                        sums[1] = sums[1] + tap * read(square + from);
                        sums[2] = sums[2] + tap * read(product + from);
                    });
                    const int64_t b = at + part.begin;
                    convolve(some, channels, w, down[0].middle + part.begin, m);
                    convolve(some, channels, w, down[1].middle + part.begin, s);
                    convolve(some, channels, w, down[2].middle + part.begin, p);
                    for (int i = 0; i < some; ++i) {
                        const float towards = m[i] + 2 * x[b + i] * s[i] + y[b + i] * p[i];
                        gradient[b + i] += share[b + i] > 0 ? ssim_weight * towards : 0;
                    }
                });
            });
        }
        out[1] = out[2] = 0;
        for (int k = 0; k < pieces; ++k) out[1] += sums[2 * k], out[2] += sums[2 * k + 1];
        if (!(ssim_weight > 0)) out[2] = 1;
        out[0] = (1 - ssim_weight) * out[1] + ssim_weight * (1 - out[2]);
    });
}

// The losses of alpha, depth and labels over n pixels, and their gradients. out: {sum(judged |alpha - inside|),
// sum(known |depth / target_depth - alpha|), sum(labelled (mismatch + 1 where the pixel has a label))}; the gradients of
// the first two, times their weights, are written. inverse: the second is sum(known |alpha^2 / depth - 1 /
// target_depth|), alpha / depth being 0 where nothing is. mismatch, labelled and ids are null without labels. 0 = done,
// 1 = out of memory.
int ss_surface_loss(int64_t n, const float* alpha, const float* depth, const float* mismatch, const float* inside,
                    const float* judged, const float* target_depth, const float* known, const float* labelled,
                    const int32_t* ids, float alpha_weight, float depth_weight, int inverse,
                    float* towards_alpha, float* towards_depth, double* out, int threads) {
    constexpr int64_t kPixels = 1 << 14;  // in one piece
    constexpr int kSome = 1024;
    struct Sums {
        double term[3];
    };
    return guarded([&] {
        std::vector<Sums> sums((n + kPixels - 1) / kPixels);
        parallel::each(threads, (int64_t)sums.size(), [&](int64_t piece) {
            float terms[3][kSome] = {};
            Sum sum[3];
            const int64_t end = std::min(n, (piece + 1) * kPixels);
            for (int64_t begin = piece * kPixels; begin < end; begin += kSome) {
                const int count = (int)std::min<int64_t>(kSome, end - begin);
                for (int k = 0; k < count; ++k) {
                    const int64_t i = begin + k;
                    const float a = alpha[i] - inside[i], r = depth[i] / target_depth[i] - alpha[i];
                    const float slope = depth_weight * known[i] * (float)((r > 0) - (r < 0));
                    terms[0][k] = judged[i] * std::fabs(a), terms[1][k] = known[i] * std::fabs(r);
                    towards_alpha[i] = alpha_weight * judged[i] * (float)((a > 0) - (a < 0)) - slope;
                    towards_depth[i] = slope / target_depth[i];
                }
                if (inverse)
                    for (int k = 0; k < count; ++k) {
                        const int64_t i = begin + k;
                        const float a = alpha[i] - inside[i], near = depth[i] > 0 ? alpha[i] / depth[i] : 0.0f;
                        const float r = alpha[i] * near - 1 / target_depth[i];
                        const float slope = depth_weight * known[i] * (float)((r > 0) - (r < 0));
                        terms[1][k] = known[i] * std::fabs(r);
                        towards_alpha[i] = alpha_weight * judged[i] * (float)((a > 0) - (a < 0)) + 2 * slope * near;
                        towards_depth[i] = -slope * near * near;
                    }
                if (labelled)
                    for (int k = 0; k < count; ++k) {
                        const int64_t i = begin + k;
                        terms[2][k] = labelled[i] * (mismatch[i] + (ids[i] >= 0 ? 1.0f : 0.0f));
                    }
                for (int t = 0; t < 3; ++t) sum[t].add(terms[t], count);
            }
            for (int t = 0; t < 3; ++t) sums[piece].term[t] = sum[t].total;
        });
        for (int t = 0; t < 3; ++t) {
            out[t] = 0;
            for (const Sums& of_piece : sums) out[t] += of_piece.term[t];
        }
    });
}

// One step of Adam (Kingma & Ba 2015, betas 0.9 and 0.999), in place. 0 = done, 1 = out of memory.
int ss_adam(int64_t rows, int count, const Learnt* parameters, int64_t step, double epsilon, int threads) {
    constexpr int64_t kRows = 1 << 12;  // in one piece
    constexpr int64_t kPaced = 256;     // of these, moved at paces of their own together
    const float upright = (float)(1 / std::sqrt(1 - std::pow(0.999, (double)step))), small = (float)epsilon;
    const double debias = 1 / (1 - std::pow(0.9, (double)step));
    // By value: what is reached through a reference may change with every write, and no loop would become vector code.
    const auto update = [=](const Learnt p, int64_t begin, int64_t end, double rate) {
        const float scale = (float)(rate * debias);
        for (int64_t i = begin; i < end; ++i) {
            const float g = p.gradient[i];
            p.first[i] = 0.9f * p.first[i] + 0.1f * g;
            p.second[i] = 0.999f * p.second[i] + 0.001f * g * g;
            p.value[i] -= scale * p.first[i] / (std::sqrt(p.second[i]) * upright + small);
        }
    };
    // A step is as long as its rate: one of rate 1 is cut to the pace of each row.
    const auto update_paced = [=](const Learnt p, int64_t begin, int64_t end, float* before) {
        float* const v = p.value + begin * p.width;
        const int64_t values = (end - begin) * p.width;
        std::copy_n(v, values, before);
        update(p, begin * p.width, end * p.width, 1);
        for (int64_t i = 0; i < values; ++i) v[i] -= before[i];
        for (int64_t r = begin; r < end; ++r)
            for (int64_t i = 0; i < p.width; ++i) v[(r - begin) * p.width + i] *= p.paces[r];
        for (int64_t i = 0; i < values; ++i) v[i] += before[i];
    };
    return guarded([&] {
        parallel::each(threads, (rows + kRows - 1) / kRows, [&](int64_t piece) {
            const int64_t begin = piece * kRows, end = std::min(rows, begin + kRows);
            for (int k = 0; k < count; ++k) {
                const Learnt& p = parameters[k];
                if (p.paces) {
                    std::vector<float> before(kPaced * p.width);
                    for (int64_t r = begin; r < end; r += kPaced)
                        update_paced(p, r, std::min(end, r + kPaced), before.data());
                } else if (p.active == p.width && (p.head == 0 || p.head == p.width)) {
                    // In one go: short loops do not become vector code.
                    update(p, begin * p.width, end * p.width, p.head == 0 ? p.rate : p.head_rate);
                } else {
                    for (int64_t r = begin; r < end; ++r) {
                        update(p, r * p.width, r * p.width + p.head, p.head_rate);
                        update(p, r * p.width + p.head, r * p.width + p.active, p.rate);
                    }
                }
            }
        });
    });
}
}
