// Colour from real spherical harmonics up to degree 3 (constants: the orthonormal basis, Condon-Shortley phase).
#pragma once

#include <cmath>

#include "scene.h"

namespace harmonics {

constexpr float k0 = 0.28209479177387814f;   // sqrt(1 / (4 pi))
constexpr float k1 = 0.4886025119029199f;    // sqrt(3 / (4 pi))
constexpr float k2a = 1.0925484305920792f;   // sqrt(15 / (4 pi))
constexpr float k2b = 0.31539156525252005f;  // sqrt(5 / (16 pi))
constexpr float k2c = 0.5462742152960396f;   // sqrt(15 / (16 pi))
constexpr float k3a = 0.5900435899266435f;   // sqrt(35 / (32 pi))
constexpr float k3b = 2.890611442640554f;    // sqrt(105 / (4 pi))
constexpr float k3c = 0.4570457994644658f;   // sqrt(21 / (32 pi))
constexpr float k3d = 0.3731763325901154f;   // sqrt(7 / (16 pi))
constexpr float k3e = 1.445305721320277f;    // sqrt(105 / (16 pi))

inline int count(int degree) { return (degree + 1) * (degree + 1); }

inline void basis(int degree, float x, float y, float z, float* b) {
    b[0] = k0;
    if (degree < 1) return;
    b[1] = -k1 * y, b[2] = k1 * z, b[3] = -k1 * x;
    if (degree < 2) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    b[4] = k2a * x * y, b[5] = -k2a * y * z, b[6] = k2b * (2 * zz - xx - yy), b[7] = -k2a * x * z;
    b[8] = k2c * (xx - yy);
    if (degree < 3) return;
    b[9] = -k3a * y * (3 * xx - yy), b[10] = k3b * x * y * z, b[11] = -k3c * y * (4 * zz - xx - yy);
    b[12] = k3d * z * (2 * zz - 3 * xx - 3 * yy), b[13] = -k3c * x * (4 * zz - xx - yy);
    b[14] = k3e * z * (xx - yy), b[15] = -k3a * x * (xx - 3 * yy);
}

// dL/d(direction) from dL/d(basis).
inline void basis_backward(int degree, float x, float y, float z, const float* g, float (&d)[3]) {
    d[0] = d[1] = d[2] = 0;
    if (degree < 1) return;
    d[0] -= k1 * g[3], d[1] -= k1 * g[1], d[2] += k1 * g[2];
    if (degree < 2) return;
    d[0] += k2a * (y * g[4] - z * g[7]) - 2 * k2b * x * g[6] + 2 * k2c * x * g[8];
    d[1] += k2a * (x * g[4] - z * g[5]) - 2 * k2b * y * g[6] - 2 * k2c * y * g[8];
    d[2] += -k2a * (y * g[5] + x * g[7]) + 4 * k2b * z * g[6];
    if (degree < 3) return;
    const float xx = x * x, yy = y * y, zz = z * z;
    d[0] += -6 * k3a * x * y * g[9] + k3b * y * z * g[10] + 2 * k3c * x * y * g[11] - 6 * k3d * x * z * g[12] -
            k3c * (4 * zz - 3 * xx - yy) * g[13] + 2 * k3e * x * z * g[14] - 3 * k3a * (xx - yy) * g[15];
    d[1] += -3 * k3a * (xx - yy) * g[9] + k3b * x * z * g[10] - k3c * (4 * zz - xx - 3 * yy) * g[11] -
            6 * k3d * y * z * g[12] + 2 * k3c * x * y * g[13] - 2 * k3e * y * z * g[14] + 6 * k3a * x * y * g[15];
    d[2] += k3b * x * y * g[10] - 8 * k3c * y * z * g[11] + k3d * (6 * zz - 3 * xx - 3 * yy) * g[12] -
            8 * k3c * x * z * g[13] + k3e * (xx - yy) * g[14];
}

inline float direction(const Scene& s, const float* center, int64_t i, float (&d)[3]) {
    float length = 0;
    for (int j = 0; j < 3; ++j) d[j] = s.means[3 * i + j] - center[j], length += d[j] * d[j];
    length = std::sqrt(std::fmax(length, 1e-24f));
    for (float& x : d) x /= length;
    return length;
}

inline void evaluate(const Scene& s, const float* center, int64_t i, float* color) {
    float d[3] = {0, 0, 1}, b[16];
    if (s.sh_degree > 0) direction(s, center, i, d);
    basis(s.sh_degree, d[0], d[1], d[2], b);
    const float* sh = s.sh + 3 * s.sh_coefficients * i;
    float sum[3] = {0.5f, 0.5f, 0.5f};
    for (int k = 0; k < count(s.sh_degree); ++k)
        for (int c = 0; c < 3; ++c) sum[c] += b[k] * sh[3 * k + c];
    for (int c = 0; c < 3; ++c) color[c] = std::fmax(sum[c], 0.0f);
}

// Writes dL/d(sh) and adds to dL/d(mean).
inline void backward(const Scene& s, const float* center, int64_t i, const float* color_gradient, float* out,
                     float (&mean)[3]) {
    float d[3] = {0, 0, 1}, b[16], g[16], color[3];
    const float length = s.sh_degree > 0 ? direction(s, center, i, d) : 1;
    evaluate(s, center, i, color);
    basis(s.sh_degree, d[0], d[1], d[2], b);
    const float* sh = s.sh + 3 * s.sh_coefficients * i;
    float* gradient = out + 3 * s.sh_coefficients * i;
    float masked[3];
    for (int c = 0; c < 3; ++c) masked[c] = color[c] > 0 ? color_gradient[c] : 0.0f;
    for (int k = 0; k < count(s.sh_degree); ++k) {
        g[k] = 0;
        for (int c = 0; c < 3; ++c) {
            gradient[3 * k + c] = b[k] * masked[c];
            g[k] += sh[3 * k + c] * masked[c];
        }
    }
    if (s.sh_degree == 0) return;
    float along[3];
    basis_backward(s.sh_degree, d[0], d[1], d[2], g, along);
    const float radial = along[0] * d[0] + along[1] * d[1] + along[2] * d[2];
    for (int j = 0; j < 3; ++j) mean[j] += (along[j] - radial * d[j]) / length;
}

}  // namespace harmonics
