// What one view says about points of a surface: whether it sees them (Split&Splat, Eq. 1-2), and whether its mask holds
// them. In the order of NumPy's operations: no product is fused with the sum that follows, but in the rotation, as
// matrix products of libraries fuse it.

#include <algorithm>
#include <cmath>
#include <cstdint>

extern "C" {

struct VotingView {
    const float* depth;               // [*, depth_width] z-depth, 0 = unknown
    const uint8_t* mask;              // [height, width]
    const int64_t *rows, *columns;    // [height], [width] the depth map's, under the pixels of the view
    int32_t width, height, depth_width, number;
    double fx, fy, cx, cy;
    double world_to_camera[12];
    double tolerance, share;          // two depths z are of one surface when less than max(tolerance, share z) apart
};
}

namespace {

constexpr int kSome = 512;

// Image points and depth of n points [n, 3]. Loops of their own, so that no compiler fuses a product and a sum.
void project(const VotingView& view, const float* points, int n, double* __restrict u, double* __restrict v,
             double* __restrict z) {
    const double *m = view.world_to_camera, fx = view.fx, fy = view.fy, cx = view.cx, cy = view.cy;
    double* const to[3] = {u, v, z};
    for (int r = 0; r < 3; ++r)
        for (int i = 0; i < n; ++i) {
            const float* p = points + 3 * i;
            to[r][i] = std::fma(m[4 * r + 2], (double)p[2], std::fma(m[4 * r + 1], (double)p[1], m[4 * r] * p[0])) +
                       m[4 * r + 3];
        }
    for (int i = 0; i < n; ++i) u[i] = u[i] / z[i] * fx, v[i] = v[i] / z[i] * fy;
    for (int i = 0; i < n; ++i) u[i] += cx, v[i] += cy;
}

}  // namespace

extern "C" {

// Adds a view's votes about `count` points [count, 3]: to `seen` that it sees them, to `held` that its mask holds them.
// of: the view that each point comes from, which has no vote about it.
void ss_vote(const VotingView* view, int64_t count, const float* points, const int32_t* of, int32_t* seen,
             int32_t* held) {
    double u[kSome], v[kSome], z[kSome];
    for (int64_t begin = 0; begin < count; begin += kSome) {
        const int n = (int)std::min<int64_t>(kSome, count - begin);
        project(*view, points + 3 * begin, n, u, v, z);
        for (int i = 0; i < n; ++i) {
            if (!(z[i] > 0 && u[i] >= 0 && v[i] >= 0 && u[i] < view->width && v[i] < view->height)) continue;
            const int column = (int)u[i], row = (int)v[i];
            const float there = view->depth[view->rows[row] * view->depth_width + view->columns[column]];
            const double most = std::max(view->tolerance, view->share * z[i]);
            if (!(there > 0 && std::fabs(there - z[i]) < most) || of[begin + i] == view->number) continue;
            ++seen[begin + i];
            held[begin + i] += view->mask[(int64_t)row * view->width + column];
        }
    }
}
}
