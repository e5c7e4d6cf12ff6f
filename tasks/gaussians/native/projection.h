// Gaussians, sixteen at a time: world to screen, and the gradient back (EWA splatting, Zwicker et al. 2001).
#pragma once

#include <cmath>

#include "harmonics.h"

namespace projection {

using lanes::less;
using lanes::splat;
using lanes::square_root;
using lanes::V16;
using lanes::where_less;

constexpr float kLog2E = 1.4426950408889634f;
constexpr float kDilation = 0.3f;         // pixels^2 added to the screen covariance
constexpr double kBeyond = 0.15;          // share of the photo's width or height that limits of slopes lie beyond it
constexpr float kMinAlpha = 1.0f / 255;   // contributions below are skipped
constexpr float kLog2MinAlpha = -7.994353436858858f;

struct View {
    float R[3][3], t[3], center[3];
    float fx, fy, cx, cy, near_plane;
    float low_x, high_x, low_y, high_y;  // the slopes x / z, y / z between which the Jacobian is evaluated
};

inline View view_of(const Scene& s) {
    View v;
    const double* m = s.world_to_camera;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) v.R[i][j] = (float)m[4 * i + j];
        v.t[i] = (float)m[4 * i + 3];
        v.center[i] = (float)-(m[i] * m[3] + m[4 + i] * m[7] + m[8 + i] * m[11]);
    }
    v.fx = (float)s.fx, v.fy = (float)s.fy, v.cx = (float)s.cx, v.cy = (float)s.cy;
    v.near_plane = (float)s.near_plane;
    // As gsplat does, and for a principal point in the middle 3DGS. Of the photo and not of a crop of it: a crop shows
    // what the photo shows there.
    const double beyond_x = kBeyond * (s.borders[2] - s.borders[0]), beyond_y = kBeyond * (s.borders[3] - s.borders[1]);
    v.low_x = (float)(s.borders[0] - beyond_x), v.high_x = (float)(s.borders[2] + beyond_x);
    v.low_y = (float)(s.borders[1] - beyond_y), v.high_y = (float)(s.borders[3] + beyond_y);
    return v;
}

// Everything between the parameters and the screen that the gradient needs again.
struct Footprint {
    V16 mean[3];                        // world
    V16 x, y, z, inv_z, tx, ty;         // camera frame; tx = x / z and ty = y / z, clamped
    V16 free_x, free_y;                 // 1 = not clamped
    V16 unit[4], norm;                  // quaternion
    V16 rotation[3][3], scale[3];
    V16 V[3][3], T[2][3];               // V = R rotation diag(scale), T = J V
    V16 j00, j02, j11, j12;             // the Jacobian J; j01 = j10 = 0
    V16 u, v, c00, c01, c11;            // screen mean and covariance
    V16 shear, kx, ky;                  // its inverse, as kx (dx + shear dy)^2 + ky dy^2
    V16 chord;                          // sqrt(1 - correlation^2)
    V16 transparency;                   // 1 - opacity
    V16 log2_opacity;
    V16 visible;                        // 0 = behind the near plane, too faint, or not finite on the screen
};

// w x y z of unit length -> rotation matrix.
inline void rotation_of(const V16 (&q)[4], V16 (&m)[3][3]) {
    const V16 &w = q[0], &x = q[1], &y = q[2], &z = q[3];
    m[0][0] = 1.0f - 2.0f * (y * y + z * z), m[0][1] = 2.0f * (x * y - w * z), m[0][2] = 2.0f * (x * z + w * y);
    m[1][0] = 2.0f * (x * y + w * z), m[1][1] = 1.0f - 2.0f * (x * x + z * z), m[1][2] = 2.0f * (y * z - w * x);
    m[2][0] = 2.0f * (x * z - w * y), m[2][1] = 2.0f * (y * z + w * x), m[2][2] = 1.0f - 2.0f * (x * x + y * y);
}

inline V16 exponential(const V16& x) { return lanes::exp2_lanes(lanes::clamp(x * kLog2E, -125, 125)); }

inline Footprint project(const Scene& s, const View& view, const Rows& rows) {
    Footprint f;
    for (int j = 0; j < 3; ++j) f.mean[j] = rows.column(s.means, 3, j);
    V16 local[3];
    for (int r = 0; r < 3; ++r)
        local[r] = view.R[r][0] * f.mean[0] + view.R[r][1] * f.mean[1] + view.R[r][2] * f.mean[2] + view.t[r];
    f.x = local[0], f.y = local[1], f.z = local[2];
    f.inv_z = 1.0f / f.z;
    f.tx = f.x * f.inv_z, f.ty = f.y * f.inv_z;
    f.u = view.fx * f.tx + view.cx, f.v = view.fy * f.ty + view.cy;
    f.free_x = 1.0f - less(f.tx, splat(view.low_x)) - less(splat(view.high_x), f.tx);
    f.free_y = 1.0f - less(f.ty, splat(view.low_y)) - less(splat(view.high_y), f.ty);
    f.tx = lanes::clamp(f.tx, view.low_x, view.high_x), f.ty = lanes::clamp(f.ty, view.low_y, view.high_y);
    f.j00 = view.fx * f.inv_z, f.j02 = -f.j00 * f.tx;
    f.j11 = view.fy * f.inv_z, f.j12 = -f.j11 * f.ty;

    for (int k = 0; k < 4; ++k) f.unit[k] = rows.column(s.quaternions, 4, k);
    const V16* q = f.unit;
    f.norm = square_root(lanes::maximum(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], splat(1e-24f)));
    for (V16& k : f.unit) k = k / f.norm;
    rotation_of(f.unit, f.rotation);
    for (int k = 0; k < 3; ++k) f.scale[k] = exponential(rows.column(s.log_scales, 3, k));
    for (int r = 0; r < 3; ++r)
        for (int k = 0; k < 3; ++k)
            f.V[r][k] = (view.R[r][0] * f.rotation[0][k] + view.R[r][1] * f.rotation[1][k] +
                         view.R[r][2] * f.rotation[2][k]) * f.scale[k];
    for (int k = 0; k < 3; ++k) {
        f.T[0][k] = f.j00 * f.V[0][k] + f.j02 * f.V[2][k];
        f.T[1][k] = f.j11 * f.V[1][k] + f.j12 * f.V[2][k];
    }
    const V16(&T)[2][3] = f.T;
    const V16 c00 = T[0][0] * T[0][0] + T[0][1] * T[0][1] + T[0][2] * T[0][2];
    const V16 c11 = T[1][0] * T[1][0] + T[1][1] * T[1][1] + T[1][2] * T[1][2];
    f.c01 = T[0][0] * T[1][0] + T[0][1] * T[1][1] + T[0][2] * T[1][2];
    // The determinant as a sum of squares (Cauchy-Binet): no cancellation, so thin needles keep their inverse.
    const V16 m01 = T[0][0] * T[1][1] - T[0][1] * T[1][0], m02 = T[0][0] * T[1][2] - T[0][2] * T[1][0];
    const V16 m12 = T[0][1] * T[1][2] - T[0][2] * T[1][1];
    const V16 det = (m01 * m01 + m02 * m02 + m12 * m12) + kDilation * (c00 + c11) + kDilation * kDilation;
    f.c00 = c00 + kDilation, f.c11 = c11 + kDilation;
    // A sum of squares, too: far along a needle, the terms with dx^2, dx dy and dy^2 are millions of times as large as
    // their sum. kx and ky are the inverse variances of x at a given y, and of y.
    f.shear = -f.c01 / f.c11, f.kx = f.c11 / det, f.ky = 1.0f / f.c11;
    f.chord = square_root(det / (f.c00 * f.c11));
    const V16 odds = exponential(-rows.column(s.opacity_logits, 1, 0));
    f.transparency = odds / (1.0f + odds);
    const V16 opacity = 1.0f / (1.0f + odds);
    f.log2_opacity = lanes::log2_lanes(lanes::maximum(opacity, splat(1e-30f)));
    // Comparisons that a NaN fails.
    f.visible = less(splat(view.near_plane), f.z) * less(det, splat(1e30f)) * less(splat(kMinAlpha), opacity) *
                less(lanes::absolute(f.u), splat(1e30f)) * less(lanes::absolute(f.v), splat(1e30f));
    return f;
}

// What the blending sends back.
struct ScreenGradient {
    V16 g, gx, gy, gxx, gxy, gyy;  // moments of dL/d(log alpha) about the screen mean, in x + shear y and y
    V16 color[3], z;
};

inline void backproject(const Scene& s, const View& view, const Rows& rows, const ScreenGradient& in,
                        const Gradients& out) {
    const Footprint f = project(s, view, rows);
    // alpha = o exp(-q / 2), q = kx (dx + shear dy)^2 + ky dy^2, dx = pixel - mean.
    const V16 du = f.kx * in.gx, dv = f.shear * du + f.ky * in.gy;
    rows.put(out.centers, 2, 0, du), rows.put(out.centers, 2, 1, dv);
    // With S = [1 shear; 0 1], D = diag(kx, ky) and the moments P, the inverse of C = T T^t + dilation is S^t D S, and
    // -dL/dK is S^-1 P S^-t / 2. So dL/dC = -K (dL/dK) K = S^t N S / 2 with N = D P D, and dL/dT = 2 (dL/dC) T =
    // S^t N S T.
    const V16 n00 = f.kx * f.kx * in.gxx, n01 = f.kx * f.ky * in.gxy, n11 = f.ky * f.ky * in.gyy;
    V16 dV[3][3], dj00 = splat(0), dj02 = splat(0), dj11 = splat(0), dj12 = splat(0);
    for (int k = 0; k < 3; ++k) {
        const V16 sheared = f.T[0][k] + f.shear * f.T[1][k];
        const V16 dT0 = n00 * sheared + n01 * f.T[1][k];
        const V16 dT1 = f.shear * dT0 + (n01 * sheared + n11 * f.T[1][k]);
        dV[0][k] = f.j00 * dT0, dV[1][k] = f.j11 * dT1, dV[2][k] = f.j02 * dT0 + f.j12 * dT1;
        dj00 = dj00 + dT0 * f.V[0][k], dj02 = dj02 + dT0 * f.V[2][k];
        dj11 = dj11 + dT1 * f.V[1][k], dj12 = dj12 + dT1 * f.V[2][k];
    }
    const V16 dtx = -f.j00 * dj02 * f.free_x, dty = -f.j11 * dj12 * f.free_y;
    const V16 along_x = du * view.fx + dtx, along_y = dv * view.fy + dty;
    const V16 local[3] = {
        along_x * f.inv_z, along_y * f.inv_z,
        // z counts in the ratios x / z and y / z, and in the factor 1 / z of the Jacobian.
        in.z - (along_x * f.x + along_y * f.y) * f.inv_z * f.inv_z -
            (dj00 * f.j00 + dj02 * f.j02 + dj11 * f.j11 + dj12 * f.j12) * f.inv_z};
    V16 world[3];
    for (int j = 0; j < 3; ++j)
        world[j] = view.R[0][j] * local[0] + view.R[1][j] * local[1] + view.R[2][j] * local[2];

    V16 dM[3][3];  // towards the rotation matrix
    for (int k = 0; k < 3; ++k) {
        V16 along = splat(0);
        for (int j = 0; j < 3; ++j) {
            const V16 d = view.R[0][j] * dV[0][k] + view.R[1][j] * dV[1][k] + view.R[2][j] * dV[2][k];
            along = along + d * f.rotation[j][k];
            dM[j][k] = d * f.scale[k];
        }
        rows.put(out.log_scales, 3, k, along * f.scale[k]);
    }
    const V16 &w = f.unit[0], &x = f.unit[1], &y = f.unit[2], &z = f.unit[3];
    const V16 q[4] = {
        2.0f * (x * (dM[2][1] - dM[1][2]) + y * (dM[0][2] - dM[2][0]) + z * (dM[1][0] - dM[0][1])),
        2.0f * (w * (dM[2][1] - dM[1][2]) + y * (dM[0][1] + dM[1][0]) + z * (dM[0][2] + dM[2][0]) -
                2.0f * x * (dM[1][1] + dM[2][2])),
        2.0f * (w * (dM[0][2] - dM[2][0]) + x * (dM[0][1] + dM[1][0]) + z * (dM[1][2] + dM[2][1]) -
                2.0f * y * (dM[0][0] + dM[2][2])),
        2.0f * (w * (dM[1][0] - dM[0][1]) + x * (dM[0][2] + dM[2][0]) + y * (dM[1][2] + dM[2][1]) -
                2.0f * z * (dM[0][0] + dM[1][1]))};
    const V16 radial = q[0] * w + q[1] * x + q[2] * y + q[3] * z;
    for (int k = 0; k < 4; ++k) rows.put(out.quaternions, 4, k, (q[k] - radial * f.unit[k]) / f.norm);

    rows.put(out.opacity_logits, 1, 0, in.g * f.transparency);
    harmonics::backward(s, view.center, rows, f.mean, in.color, out.sh, world);
    for (int j = 0; j < 3; ++j) rows.put(out.means, 3, j, world[j]);
}

}  // namespace projection
