// L1 + SSIM of two images with its gradient, weighted L1, and Adam: loops over whole arrays, in a fixed order.

#include <cmath>
#include <cstdint>
#include <exception>
#include <vector>

namespace {

constexpr int kRadius = 5;  // an 11 x 11 window, sigma 1.5 (Wang et al. 2004)
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
    float tap[kRadius + 1];
    Window() {
        double sum = 0;
        for (int k = -kRadius; k <= kRadius; ++k) sum += std::exp(-k * k / 4.5);
        for (int k = 0; k <= kRadius; ++k) tap[k] = (float)(std::exp(-k * k / 4.5) / sum);
    }
};

// Row-major planes of width * channels floats a row, zero beyond the border.
struct Plane {
    int width, height, channels;  // interleaved
    int row() const { return width * channels; }
    size_t size() const { return (size_t)row() * height; }
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

// Separable Gaussian blur with zeros beyond the border; symmetric, so it is its own transpose.
void blur(const Plane& plane, const Window& w, const float* in, float* out, std::vector<float>& line) {
    const int n = plane.row(), step = plane.channels, pad = kRadius * step;
    line.assign(n + 2 * pad, 0.0f);
    float* middle = line.data() + pad;
    for (int y = 0; y < plane.height; ++y) {
        const float* at = in + (size_t)y * n;
        if (y >= kRadius && y + kRadius < plane.height) {
            convolve(n, n, w, at, middle);
        } else {
            for (int i = 0; i < n; ++i) middle[i] = w.tap[0] * at[i];
            for (int k = 1; k <= kRadius; ++k) {
                const float tap = w.tap[k];
                if (y >= k)
                    for (int i = 0; i < n; ++i) middle[i] += tap * at[i - k * n];
                if (y + k < plane.height)
                    for (int i = 0; i < n; ++i) middle[i] += tap * at[i + k * n];
            }
        }
        convolve(n, step, w, middle, out + (size_t)y * n);
    }
}

// Per pixel s = (a1 a2) / (b1 b2) from the blurred x, y, xx, yy, xy. mx, mxx, mxy become the gradients towards
// themselves, `shares` the pixels' shares of the mean.
void compare(size_t n, float ssim_weight, const float* __restrict share, const float* __restrict my,
             const float* __restrict myy, float* __restrict mx, float* __restrict mxx, float* __restrict mxy,
             float* __restrict shares) {
    for (size_t i = 0; i < n; ++i) {
        const float u = mx[i], v = my[i];
        const float b1 = u * u + v * v + kC1, b2 = (mxx[i] - u * u) + (myy[i] - v * v) + kC2;
        const float a1 = 2 * u * v + kC1, a2 = 2 * (mxy[i] - u * v) + kC2;
        const float inverse = 1 / (b1 * b2), s = a1 * a2 * inverse, g = -ssim_weight * share[i];
        shares[i] = share[i] * s;
        mx[i] = g * (2 * v * (a2 - a1) * inverse - 2 * u * s * inverse * (b2 - b1));
        mxx[i] = -g * s * b1 * inverse;
        mxy[i] = g * 2 * a1 * inverse;
    }
}

}  // namespace

extern "C" {

// (1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM), means over the pixels of weight > 0 and their channels. Both
// images are taken as zero where the weight is 0. image, target, gradient: [H, W, C]; weight: [H, W]. out: loss, L1,
// SSIM. 0 = done, 1 = out of memory.
int ss_photometric(int32_t width, int32_t height, int32_t channels, const float* image, const float* target,
                   const float* weight, float ssim_weight, float* gradient, double* out) {
    try {
        const Plane plane = {width, height, channels};
        const size_t n = plane.size();
        double area = 0, l1 = 0, ssim = 0;
        for (size_t p = 0; p < n / channels; ++p) area += weight[p];
        out[0] = out[1] = 0, out[2] = 1;
        if (!(area > 0)) {
            for (size_t i = 0; i < n; ++i) gradient[i] = 0;
            return 0;
        }
        const float norm = (float)(1 / (area * channels));
        std::vector<float> x(n), y(n), share(n), line;
        for (size_t p = 0, i = 0; p < n / channels; ++p)
            for (int c = 0; c < channels; ++c, ++i) {
                const bool counts = weight[p] > 0;
                x[i] = counts ? image[i] : 0, y[i] = counts ? target[i] : 0, share[i] = weight[p] * norm;
                const float d = x[i] - y[i];
                l1 += share[i] * std::fabs(d);
                gradient[i] = (1 - ssim_weight) * share[i] * (float)((d > 0) - (d < 0));
            }
        out[1] = l1, out[0] = (1 - ssim_weight) * l1;
        if (ssim_weight > 0) {
            const Window w;
            std::vector<float> product(n), mx(n), my(n), mxx(n), myy(n), mxy(n);
            blur(plane, w, x.data(), mx.data(), line);
            blur(plane, w, y.data(), my.data(), line);
            for (size_t i = 0; i < n; ++i) product[i] = x[i] * x[i];
            blur(plane, w, product.data(), mxx.data(), line);
            for (size_t i = 0; i < n; ++i) product[i] = y[i] * y[i];
            blur(plane, w, product.data(), myy.data(), line);
            for (size_t i = 0; i < n; ++i) product[i] = x[i] * y[i];
            blur(plane, w, product.data(), mxy.data(), line);
            compare(n, ssim_weight, share.data(), my.data(), myy.data(), mx.data(), mxx.data(), mxy.data(), product.data());
            for (size_t i = 0; i < n; ++i) ssim += product[i];
            blur(plane, w, mx.data(), my.data(), line);
            blur(plane, w, mxx.data(), myy.data(), line);
            blur(plane, w, mxy.data(), product.data(), line);
            for (size_t p = 0, i = 0; p < n / channels; ++p)
                for (int c = 0; c < channels; ++c, ++i)
                    if (weight[p] > 0) gradient[i] += my[i] + 2 * x[i] * myy[i] + y[i] * product[i];
            out[2] = ssim, out[0] += ssim_weight * (1 - ssim);
        }
        return 0;
    } catch (const std::exception&) {
        return 1;
    }
}

// Sum of weight * |value - target|; writes its gradient.
double ss_weighted_l1(int64_t n, const float* value, const float* target, const float* weight, float* gradient) {
    double sum = 0;
    for (int64_t i = 0; i < n; ++i) {
        const float d = value[i] - target[i];
        sum += weight[i] * std::fabs(d);
        gradient[i] = weight[i] * (float)((d > 0) - (d < 0));
    }
    return sum;
}

// One step of Adam (Kingma & Ba 2015, betas 0.9 and 0.999), in place.
void ss_adam(int64_t n, float* value, const float* gradient, float* first, float* second, double rate, int64_t step,
             double epsilon) {
    const float correct = (float)(1 / std::sqrt(1 - std::pow(0.999, (double)step)));
    const float scale = (float)(rate / (1 - std::pow(0.9, (double)step))), small = (float)epsilon;
    for (int64_t i = 0; i < n; ++i) {
        const float g = gradient[i];
        first[i] = 0.9f * first[i] + 0.1f * g;
        second[i] = 0.999f * second[i] + 0.001f * g * g;
        value[i] -= scale * first[i] / (std::sqrt(second[i]) * correct + small);
    }
}
}
