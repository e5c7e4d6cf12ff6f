// One Gaussian: world to screen, and the gradient back.
#pragma once

#include <cmath>

#include "harmonics.h"
#include "scene.h"

namespace projection {

constexpr float kDilation = 0.3f;        // pixels^2 added to the screen covariance
constexpr float kMinAlpha = 1.0f / 255;  // contributions below are skipped
constexpr float kMinCompensation = 2.5e-5f;

struct View {
    float R[3][3], t[3], center[3];
    float fx, fy, cx, cy, near_plane;
    float tan_x, tan_y;  // the Jacobian is evaluated no further than this off the axis
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
    const double far_x = std::fmax(std::fabs(s.cx), std::fabs(s.width - s.cx)) / s.fx;
    const double far_y = std::fmax(std::fabs(s.cy), std::fabs(s.height - s.cy)) / s.fy;
    v.tan_x = (float)std::fmax(2.0, 1.3 * far_x);
    v.tan_y = (float)std::fmax(2.0, 1.3 * far_y);
    return v;
}

// Everything between the parameters and the screen that the gradient needs again.
struct Footprint {
    float x, y, z, tx, ty;     // camera frame; tx = x / z and ty = y / z, clamped
    bool free_x, free_y;       // not clamped
    float rotation[3][3], scale[3], norm;
    float V[3][3], T[2][3];    // V = R rotation diag(scale), T = J V
    float J[2][3];
    float u, v, c00, c01, c11; // screen mean and covariance
    float k00, k01, k11;       // its inverse
    float sharp;               // determinant of the covariance before the dilation
    float compensation, opacity, log2_opacity;
};

inline void rotation_of(const float* q, float (&m)[3][3], float& norm) {
    norm = std::sqrt(std::fmax(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], 1e-24f));
    const float w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
    m[0][0] = 1 - 2 * (y * y + z * z), m[0][1] = 2 * (x * y - w * z), m[0][2] = 2 * (x * z + w * y);
    m[1][0] = 2 * (x * y + w * z), m[1][1] = 1 - 2 * (x * x + z * z), m[1][2] = 2 * (y * z - w * x);
    m[2][0] = 2 * (x * z - w * y), m[2][1] = 2 * (y * z + w * x), m[2][2] = 1 - 2 * (x * x + y * y);
}

// False where the Gaussian cannot show: behind the near plane, too faint, or not finite on the screen.
inline bool project(const Scene& s, const View& view, int64_t i, Footprint& f) {
    const float* m = s.means + 3 * i;
    float local[3];
    for (int r = 0; r < 3; ++r)
        local[r] = view.R[r][0] * m[0] + view.R[r][1] * m[1] + view.R[r][2] * m[2] + view.t[r];
    f.x = local[0], f.y = local[1], f.z = local[2];
    if (!(f.z > view.near_plane)) return false;
    const float inv_z = 1 / f.z;
    f.tx = f.x * inv_z, f.ty = f.y * inv_z;
    f.u = view.fx * f.tx + view.cx, f.v = view.fy * f.ty + view.cy;
    f.free_x = std::fabs(f.tx) <= view.tan_x, f.free_y = std::fabs(f.ty) <= view.tan_y;
    f.tx = std::fmin(std::fmax(f.tx, -view.tan_x), view.tan_x);
    f.ty = std::fmin(std::fmax(f.ty, -view.tan_y), view.tan_y);
    f.J[0][0] = view.fx * inv_z, f.J[0][1] = 0, f.J[0][2] = -view.fx * f.tx * inv_z;
    f.J[1][0] = 0, f.J[1][1] = view.fy * inv_z, f.J[1][2] = -view.fy * f.ty * inv_z;
    rotation_of(s.quaternions + 4 * i, f.rotation, f.norm);
    for (int k = 0; k < 3; ++k) f.scale[k] = std::exp(s.log_scales[3 * i + k]);
    for (int r = 0; r < 3; ++r)
        for (int k = 0; k < 3; ++k) {
            float sum = 0;
            for (int j = 0; j < 3; ++j) sum += view.R[r][j] * f.rotation[j][k];
            f.V[r][k] = sum * f.scale[k];
        }
    for (int r = 0; r < 2; ++r)
        for (int k = 0; k < 3; ++k) f.T[r][k] = f.J[r][r] * f.V[r][k] + f.J[r][2] * f.V[2][k];
    float c00 = 0, c01 = 0, c11 = 0;
    for (int k = 0; k < 3; ++k) {
        c00 += f.T[0][k] * f.T[0][k];
        c01 += f.T[0][k] * f.T[1][k];
        c11 += f.T[1][k] * f.T[1][k];
    }
    // The determinant as a sum of squares (Cauchy-Binet): no cancellation, so thin needles keep their inverse.
    const float m01 = f.T[0][0] * f.T[1][1] - f.T[0][1] * f.T[1][0];
    const float m02 = f.T[0][0] * f.T[1][2] - f.T[0][2] * f.T[1][0];
    const float m12 = f.T[0][1] * f.T[1][2] - f.T[0][2] * f.T[1][1];
    f.sharp = m01 * m01 + m02 * m02 + m12 * m12;
    const float det = f.sharp + kDilation * (c00 + c11) + kDilation * kDilation;
    f.c00 = c00 + kDilation, f.c01 = c01, f.c11 = c11 + kDilation;
    if (!(det < 1e30f) || !std::isfinite(f.u) || !std::isfinite(f.v)) return false;
    f.k00 = f.c11 / det, f.k01 = -f.c01 / det, f.k11 = f.c00 / det;
    f.compensation = s.antialias ? std::sqrt(std::fmax(f.sharp / det, kMinCompensation)) : 1.0f;
    f.opacity = 1 / (1 + std::exp(-s.opacity_logits[i]));
    const float visible = f.opacity * f.compensation;
    if (!(visible > kMinAlpha)) return false;
    f.log2_opacity = std::log2(visible);
    return true;
}

// What the blending sends back for one Gaussian.
struct ScreenGradient {
    float g, gx, gy, gxx, gxy, gyy;  // moments of dL/d(log alpha) about the screen mean
    float color[3], z;
};

inline void backproject(const Scene& s, const View& view, int64_t i, const Footprint& f, const ScreenGradient& in,
                        const Gradients& out) {
    // alpha = o exp(-q / 2), q = k00 dx^2 + 2 k01 dx dy + k11 dy^2, dx = pixel - mean.
    const float du = f.k00 * in.gx + f.k01 * in.gy, dv = f.k01 * in.gx + f.k11 * in.gy;
    // dL/dC = -K (dL/dK) K with dL/dK = -moments / 2.
    const float a0 = f.k00 * in.gxx + f.k01 * in.gxy, a1 = f.k00 * in.gxy + f.k01 * in.gyy;
    const float b0 = f.k01 * in.gxx + f.k11 * in.gxy, b1 = f.k01 * in.gxy + f.k11 * in.gyy;
    float g00 = 0.5f * (a0 * f.k00 + a1 * f.k01), g01 = 0.5f * (a0 * f.k01 + a1 * f.k11);
    float g11 = 0.5f * (b0 * f.k01 + b1 * f.k11);
    if (s.antialias && f.compensation * f.compensation > kMinCompensation) {
        // d log compensation / dC = (C0^-1 - C^-1) / 2, C0 the covariance before the dilation.
        const float c00 = f.c00 - kDilation, c11 = f.c11 - kDilation, w = 0.5f * in.g;
        g00 += w * (c11 / f.sharp - f.k00), g11 += w * (c00 / f.sharp - f.k11);
        g01 += w * (-f.c01 / f.sharp - f.k01);
    }
    float dT[2][3], dJ[2][3] = {}, dV[3][3];
    for (int k = 0; k < 3; ++k) {
        dT[0][k] = 2 * (g00 * f.T[0][k] + g01 * f.T[1][k]);
        dT[1][k] = 2 * (g01 * f.T[0][k] + g11 * f.T[1][k]);
        dV[0][k] = f.J[0][0] * dT[0][k];
        dV[1][k] = f.J[1][1] * dT[1][k];
        dV[2][k] = f.J[0][2] * dT[0][k] + f.J[1][2] * dT[1][k];
        dJ[0][0] += dT[0][k] * f.V[0][k], dJ[0][2] += dT[0][k] * f.V[2][k];
        dJ[1][1] += dT[1][k] * f.V[1][k], dJ[1][2] += dT[1][k] * f.V[2][k];
    }
    const float inv_z = 1 / f.z;
    const float dtx = -view.fx * inv_z * dJ[0][2] * (f.free_x ? 1.0f : 0.0f);
    const float dty = -view.fy * inv_z * dJ[1][2] * (f.free_y ? 1.0f : 0.0f);
    float local[3];
    local[0] = (du * view.fx + dtx) * inv_z;
    local[1] = (dv * view.fy + dty) * inv_z;
    // tx stands for x / z: through z once as the ratio, once as the factor 1 / z of the Jacobian.
    const float ratio_x = f.x * inv_z, ratio_y = f.y * inv_z;
    local[2] = in.z - (du * view.fx * ratio_x + dv * view.fy * ratio_y + dtx * ratio_x + dty * ratio_y) * inv_z -
               (dJ[0][0] * f.J[0][0] + dJ[0][2] * f.J[0][2] + dJ[1][1] * f.J[1][1] + dJ[1][2] * f.J[1][2]) * inv_z;
    float world[3];
    for (int j = 0; j < 3; ++j)
        world[j] = view.R[0][j] * local[0] + view.R[1][j] * local[1] + view.R[2][j] * local[2];

    float dM[3][3];  // towards the rotation matrix
    for (int k = 0; k < 3; ++k) {
        float along = 0;
        for (int j = 0; j < 3; ++j) {
            const float d = view.R[0][j] * dV[0][k] + view.R[1][j] * dV[1][k] + view.R[2][j] * dV[2][k];
            along += d * f.rotation[j][k];
            dM[j][k] = d * f.scale[k];
        }
        out.log_scales[3 * i + k] = along * f.scale[k];
    }
    const float* raw = s.quaternions + 4 * i;
    const float w = raw[0] / f.norm, x = raw[1] / f.norm, y = raw[2] / f.norm, z = raw[3] / f.norm;
    float q[4];
    q[0] = 2 * (x * (dM[2][1] - dM[1][2]) + y * (dM[0][2] - dM[2][0]) + z * (dM[1][0] - dM[0][1]));
    q[1] = 2 * (w * (dM[2][1] - dM[1][2]) + y * (dM[0][1] + dM[1][0]) + z * (dM[0][2] + dM[2][0]) -
                2 * x * (dM[1][1] + dM[2][2]));
    q[2] = 2 * (w * (dM[0][2] - dM[2][0]) + x * (dM[0][1] + dM[1][0]) + z * (dM[1][2] + dM[2][1]) -
                2 * y * (dM[0][0] + dM[2][2]));
    q[3] = 2 * (w * (dM[1][0] - dM[0][1]) + x * (dM[0][2] + dM[2][0]) + y * (dM[1][2] + dM[2][1]) -
                2 * z * (dM[0][0] + dM[1][1]));
    const float radial = q[0] * w + q[1] * x + q[2] * y + q[3] * z;
    const float unit[4] = {w, x, y, z};
    for (int k = 0; k < 4; ++k) out.quaternions[4 * i + k] = (q[k] - radial * unit[k]) / f.norm;

    out.opacity_logits[i] = in.g * (1 - f.opacity);
    harmonics::backward(s, view.center, i, in.color, out.sh, world);
    for (int j = 0; j < 3; ++j) out.means[3 * i + j] = world[j];
    out.centers[2 * i] = du, out.centers[2 * i + 1] = dv;
}

}  // namespace projection
