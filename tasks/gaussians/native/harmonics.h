// Colour from real spherical harmonics up to degree 3 (constants: the orthonormal basis, Condon-Shortley phase).
#pragma once

#include "rows.h"

namespace harmonics {

using lanes::splat;
using lanes::V16;

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

inline void basis(int degree, const V16& x, const V16& y, const V16& z, V16 (&b)[16]) {
    b[0] = splat(k0);
    if (degree < 1) return;
    b[1] = y * -k1, b[2] = z * k1, b[3] = x * -k1;
    if (degree < 2) return;
    const V16 xx = x * x, yy = y * y, zz = z * z;
    b[4] = k2a * x * y, b[5] = -k2a * y * z, b[6] = k2b * (2.0f * zz - xx - yy), b[7] = -k2a * x * z;
    b[8] = k2c * (xx - yy);
    if (degree < 3) return;
    b[9] = -k3a * y * (3.0f * xx - yy), b[10] = k3b * x * y * z, b[11] = -k3c * y * (4.0f * zz - xx - yy);
    b[12] = k3d * z * (2.0f * zz - 3.0f * xx - 3.0f * yy), b[13] = -k3c * x * (4.0f * zz - xx - yy);
    b[14] = k3e * z * (xx - yy), b[15] = -k3a * x * (xx - 3.0f * yy);
}

// dL/d(direction) from dL/d(basis).
inline void basis_backward(int degree, const V16& x, const V16& y, const V16& z, const V16 (&g)[16], V16 (&d)[3]) {
    d[0] = -k1 * g[3], d[1] = -k1 * g[1], d[2] = k1 * g[2];
    if (degree < 2) return;
    d[0] = d[0] + k2a * (y * g[4] - z * g[7]) - 2 * k2b * x * g[6] + 2 * k2c * x * g[8];
    d[1] = d[1] + k2a * (x * g[4] - z * g[5]) - 2 * k2b * y * g[6] - 2 * k2c * y * g[8];
    d[2] = d[2] - k2a * (y * g[5] + x * g[7]) + 4 * k2b * z * g[6];
    if (degree < 3) return;
    const V16 xx = x * x, yy = y * y, zz = z * z;
    d[0] = d[0] - 6 * k3a * x * y * g[9] + k3b * y * z * g[10] + 2 * k3c * x * y * g[11] - 6 * k3d * x * z * g[12] -
           k3c * (4.0f * zz - 3.0f * xx - yy) * g[13] + 2 * k3e * x * z * g[14] - 3 * k3a * (xx - yy) * g[15];
    d[1] = d[1] - 3 * k3a * (xx - yy) * g[9] + k3b * x * z * g[10] - k3c * (4.0f * zz - xx - 3.0f * yy) * g[11] -
           6 * k3d * y * z * g[12] + 2 * k3c * x * y * g[13] - 2 * k3e * y * z * g[14] + 6 * k3a * x * y * g[15];
    d[2] = d[2] + k3b * x * y * g[10] - 8 * k3c * y * z * g[11] + k3d * (6.0f * zz - 3.0f * xx - 3.0f * yy) * g[12] -
           8 * k3c * x * z * g[13] + k3e * (xx - yy) * g[14];
}

struct Direction {
    V16 x, y, z, length;
    Direction(const V16 (&mean)[3], const float* center) {
        x = mean[0] - center[0], y = mean[1] - center[1], z = mean[2] - center[2];
        length = lanes::square_root(lanes::maximum(x * x + y * y + z * z, splat(1e-24f)));
        x = x / length, y = y / length, z = z / length;
    }
};

inline void evaluate(const Scene& s, const float* center, const Rows& rows, const V16 (&mean)[3], V16 (&color)[3]) {
    V16 b[16];
    const Direction d(mean, center);
    basis(s.sh_degree, d.x, d.y, d.z, b);
    for (V16& c : color) c = splat(0.5f);
    for (int k = 0; k < count(s.sh_degree); ++k)
        for (int c = 0; c < 3; ++c) color[c] = color[c] + b[k] * rows.column(s.sh, 3 * s.sh_coefficients, 3 * k + c);
    for (V16& c : color) c = lanes::maximum(c, splat(0));
}

// Writes dL/d(sh) and adds to dL/d(mean). color_gradient: 0 where the colour was cut at 0.
inline void backward(const Scene& s, const float* center, const Rows& rows, const V16 (&mean)[3],
                     const V16 (&color_gradient)[3], float* out, V16 (&mean_gradient)[3]) {
    V16 b[16], g[16] = {}, along[3];
    const Direction d(mean, center);
    const int width = 3 * s.sh_coefficients;
    basis(s.sh_degree, d.x, d.y, d.z, b);
    for (int k = 0; k < count(s.sh_degree); ++k) {
        g[k] = splat(0);
        for (int c = 0; c < 3; ++c) {
            rows.put(out, width, 3 * k + c, b[k] * color_gradient[c]);
            if (s.sh_degree > 0) g[k] = g[k] + color_gradient[c] * rows.column(s.sh, width, 3 * k + c);
        }
    }
    if (s.sh_degree == 0) return;
    basis_backward(s.sh_degree, d.x, d.y, d.z, g, along);
    const V16 radial = along[0] * d.x + along[1] * d.y + along[2] * d.z;
    mean_gradient[0] = mean_gradient[0] + (along[0] - radial * d.x) / d.length;
    mean_gradient[1] = mean_gradient[1] + (along[1] - radial * d.y) / d.length;
    mean_gradient[2] = mean_gradient[2] + (along[2] - radial * d.z) / d.length;
}

}  // namespace harmonics
