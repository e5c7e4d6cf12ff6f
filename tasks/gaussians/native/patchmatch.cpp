// PatchMatch multi-view stereo (Bleyer et al. 2011; Galliani et al. 2015): at each pixel of one photo the plane whose
// window matches other photos best, found by trying the planes of neighbours and small random changes.
//
// A plane is its inverse depth w at the pixel and the gradient (wx, wy) of inverse depth over the image, in which planes
// are linear: a neighbour's plane is carried over by a sum, and the window goes into another photo by p = A x + w(x) b
// with A = K' R K^-1 and b = K' t. One colour of a checkerboard is worked on while the other stays, sixteen pixels at a
// time, one a lane. Random numbers depend on seed, turn and pixel alone.

#include <cmath>
#include <vector>

#include "lanes.h"
#include "workspace.h"

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

extern "C" {

struct StereoPhoto {
    const uint32_t* quads;       // [height, width] gray levels of a pixel, its right, lower and lower right one, 8 bits each
    const uint8_t* usable;       // [height, width] 0 where the middle of a window may not fall
    const float* inverse_depth;  // [height, width] what is known of its depth, 0 = nothing
    int32_t width, height;
    float a[9], b[3];            // from the reference's pixels (integer centres) to its own
    float back_a[9], back_b[3];  // and back
};

struct StereoProblem {
    const uint32_t* quads;  // of the reference, as above
    const StereoPhoto* others;
    float* planes;          // [3, height, width] w, wx, wy: in and out
    float* cost;            // [height, width] out: of matching, without smoothness
    int32_t width, height, count, best, radius, step, turns;
    uint32_t seed;
    float min_inverse, max_inverse;  // of depth
    float max_slope;                 // largest |wx| / w and |wy| / w
    float gray_scale, smoothness, smooth_scale, consistency;
};
}

namespace {

constexpr int kLanes = 16, kMaxBest = 8;
constexpr float kNoise = 4;      // variance of a window by noise alone, in squared gray levels
constexpr float kUnseen = 4;     // more than any cost
constexpr float kUnrelated = 0.5f;
constexpr float kMaxMiss = 3;    // pixels
constexpr int kReach = 11;       // pixels along a row or column
constexpr int kWays[4][2] = {{-1, 0}, {1, 0}, {0, -1}, {0, 1}};

typedef float Lane[kLanes];
typedef int32_t LaneInt[kLanes];
typedef uint32_t LaneBits[kLanes];

#define EACH for (int k = 0; k < kLanes; ++k)

uint32_t hashed(uint32_t x) {  // PCG (O'Neill 2014) used as a hash
    x = x * 747796405u + 2891336453u;
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737u;
    return (x >> 22) ^ x;
}

// Compilers do not choose the instruction that reads from sixteen places by themselves.
void gather(const uint32_t* from, const LaneInt& place, LaneBits& to) {
#if defined(__AVX512F__)
    _mm512_storeu_si512(to, _mm512_i32gather_epi32(_mm512_loadu_si512(place), from, 4));
#elif defined(__AVX2__)
    for (int k = 0; k < kLanes; k += 8)
        _mm256_storeu_si256((__m256i*)(to + k),
                            _mm256_i32gather_epi32((const int*)from, _mm256_loadu_si256((const __m256i*)(place + k)), 4));
#else
    EACH to[k] = from[place[k]];
#endif
}

void exponential(Lane& x) {  // of -80 .. 80
    lanes::store(x, lanes::exp2_lanes(lanes::load(x) * 1.442695041f));
}

struct Planes {
    Lane w, wx, wy;
};

// A window goes into another photo by (px + du ux + dv vx) / (pz + du uz + dv vz), and so on.
struct Transfer {
    Lane px, py, pz, ux, uy, uz, vx, vy, vz;
};

struct Tap {
    float du, dv;
    Lane gray, weight;  // the weights of a window sum to 1, its gray levels are less their weighted mean
};

struct Neighbor {
    float dx, dy;
    Lane w, weight;
};

// Sixteen pixels of a row, and what stays while planes are tried at them.
struct Block {
    int y = 0;
    LaneInt x;
    Lane level, deviation;
    std::vector<Tap> taps;
    Neighbor neighbors[8];
};

struct Best {
    Planes planes;
    Lane match, total;
};

class Matcher {
  public:
    explicit Matcher(const StereoProblem& p) : p_(p), size_((int64_t)p.width * p.height) {}

    void run() {
        for (int color = 0; color < 2; ++color) each_block(color, [&](Block& b) { measure(b); });
        for (int turn = 0; turn < p_.turns; ++turn)
            for (int color = 0; color < 2; ++color) each_block(color, [&](Block& b) { improve(b, turn); });
    }

  private:
    template <class F>
    void each_block(int color, F visit) const {
        Block b;
        for (b.y = 0; b.y < p_.height; ++b.y) {
            const int first = (b.y + color) & 1, last = p_.width - 1 - ((p_.width - 1 - first) & 1);
            for (int x = first; x < p_.width; x += 2 * kLanes) {
                EACH b.x[k] = std::min(x + 2 * k, last);  // lanes beyond the row do the last pixel again
                prepare(b);
                visit(b);
            }
        }
    }

    int64_t at(int x, int y) const { return (int64_t)y * p_.width + x; }
    bool holds(int x, int y) const { return x >= 0 && x < p_.width && y >= 0 && y < p_.height; }
    float level(int x, int y) const {
        return (float)(p_.quads[at(std::clamp(x, 0, p_.width - 1), std::clamp(y, 0, p_.height - 1))] & 255u);
    }

    // The windows, each pixel weighted by how near it and its gray level are to the middle's.
    void prepare(Block& b) const {
        EACH b.level[k] = level(b.x[k], b.y);
        b.taps.clear();
        Lane total = {}, mean = {}, square = {};
        const float scale = 1 / p_.gray_scale, narrow = 0.5f / (float)(p_.radius * p_.radius);
        for (int dv = -p_.radius; dv <= p_.radius; dv += p_.step)
            for (int du = -p_.radius; du <= p_.radius; du += p_.step) {
                b.taps.emplace_back();
                Tap& t = b.taps.back();
                t.du = (float)du, t.dv = (float)dv;
                const float far = (float)(du * du + dv * dv) * narrow;
                EACH t.gray[k] = level(b.x[k] + du, b.y + dv);
                EACH t.weight[k] = std::max(-far - std::fabs(t.gray[k] - b.level[k]) * scale, -80.0f);
                exponential(t.weight);
                EACH total[k] += t.weight[k], mean[k] += t.weight[k] * t.gray[k];
            }
        EACH total[k] = 1 / total[k], mean[k] *= total[k];
        for (Tap& t : b.taps) EACH {
                t.weight[k] *= total[k], t.gray[k] -= mean[k];
                square[k] += t.weight[k] * t.gray[k] * t.gray[k];
            }
        EACH b.deviation[k] = std::sqrt(square[k] + kNoise);
    }

    // (1 - correlation) / 2 and what depth maps object to, as the mean over the best photos that see the window.
    void match(const Block& b, const Planes& h, Lane& cost) const {
        Lane ranked[kMaxBest], own, sum = {}, seen = {};
        for (int r = 0; r < p_.best; ++r) EACH ranked[r][k] = kUnseen;
        for (int i = 0; i < p_.count; ++i) {
            match_one(b, h, p_.others[i], own);
            for (int r = 0; r < p_.best; ++r) EACH {
                    const float less = std::min(own[k], ranked[r][k]);
                    own[k] = std::max(own[k], ranked[r][k]), ranked[r][k] = less;
                }
        }
        for (int r = 0; r < p_.best; ++r) EACH {
                sum[k] += ranked[r][k] < kUnseen ? ranked[r][k] : 0;
                seen[k] += ranked[r][k] < kUnseen ? 1.0f : 0.0f;
            }
        EACH cost[k] = seen[k] > 0 ? sum[k] / seen[k] : kUnrelated;
    }

    void match_one(const Block& b, const Planes& h, const StereoPhoto& o, Lane& cost) const {
        Transfer t;
        const float y = (float)b.y, right = (float)(o.width - 1), low = (float)(o.height - 1);
        EACH {
            const float x = (float)b.x[k];
            t.px[k] = o.a[0] * x + o.a[1] * y + o.a[2] + h.w[k] * o.b[0];
            t.py[k] = o.a[3] * x + o.a[4] * y + o.a[5] + h.w[k] * o.b[1];
            t.pz[k] = o.a[6] * x + o.a[7] * y + o.a[8] + h.w[k] * o.b[2];
            t.ux[k] = o.a[0] + h.wx[k] * o.b[0], t.vx[k] = o.a[1] + h.wy[k] * o.b[0];
            t.uy[k] = o.a[3] + h.wx[k] * o.b[1], t.vy[k] = o.a[4] + h.wy[k] * o.b[1];
            t.uz[k] = o.a[6] + h.wx[k] * o.b[2], t.vz[k] = o.a[7] + h.wy[k] * o.b[2];
        }
        LaneInt inside;
        EACH inside[k] = 1;
        for (int corner = 0; corner < 4; ++corner) {
            const float du = (float)(corner & 1 ? p_.radius : -p_.radius), dv = (float)(corner & 2 ? p_.radius : -p_.radius);
            EACH {
                const float z = t.pz[k] + du * t.uz[k] + dv * t.vz[k];
                const float u = t.px[k] + du * t.ux[k] + dv * t.vx[k], v = t.py[k] + du * t.uy[k] + dv * t.vy[k];
                inside[k] &= (z > 1e-6f) & (u >= 0) & (u <= right * z) & (v >= 0) & (v <= low * z);
            }
        }
        int any = 0;
        EACH any |= inside[k];
        EACH cost[k] = kUnseen;
        if (!any) return;
        Lane sum = {}, square = {}, product = {};
        for (const Tap& tap : b.taps) {
            const float du = tap.du, dv = tap.dv;
            Lane fu, fv;
            LaneInt place;
            LaneBits quad;
            EACH {
                const float scale = 1 / (t.pz[k] + du * t.uz[k] + dv * t.vz[k]);
                float u = (t.px[k] + du * t.ux[k] + dv * t.vx[k]) * scale;
                float v = (t.py[k] + du * t.uy[k] + dv * t.vy[k]) * scale;
                u = u > 0 ? u : 0, v = v > 0 ? v : 0;  // only of windows that are not inside
                u = u < right ? u : right, v = v < low ? v : low;
                const int i = (int)u, j = (int)v;
                fu[k] = u - (float)i, fv[k] = v - (float)j, place[k] = j * o.width + i;
            }
            gather(o.quads, place, quad);
            EACH {
                const float g00 = (float)(int)(quad[k] & 255u), g01 = (float)(int)(quad[k] >> 8 & 255u);
                const float g10 = (float)(int)(quad[k] >> 16 & 255u), g11 = (float)(int)(quad[k] >> 24);
                const float top = g00 + fu[k] * (g01 - g00), bottom = g10 + fu[k] * (g11 - g10);
                const float g = top + fv[k] * (bottom - top) - b.level[k], weighted = tap.weight[k] * g;
                sum[k] += weighted, square[k] += weighted * g, product[k] += weighted * tap.gray[k];
            }
        }
        EACH {
            const float variance = std::max(square[k] - sum[k] * sum[k], 0.0f) + kNoise;
            const float own = 0.5f - 0.5f * product[k] / (std::sqrt(variance) * b.deviation[k]);
            cost[k] = inside[k] ? own : kUnseen;
        }
        EACH if (inside[k]) cost[k] = objected(b, t, o, k, cost[k]);
    }

    // The cost of a plane that the other photo sees at a pixel with a depth of its own: dearer by how far the way there
    // by the plane, and back by that depth, misses the start (Schoenberger et al. 2016, Eq. 11).
    float objected(const Block& b, const Transfer& t, const StereoPhoto& o, int k, float cost) const {
        const float u = t.px[k] / t.pz[k], v = t.py[k] / t.pz[k];
        const int64_t place = (int64_t)(v + 0.5f) * o.width + (int64_t)(u + 0.5f);
        if (!o.usable[place]) return kUnseen;
        const float w = o.inverse_depth[place];
        if (!(w > 0)) return cost;
        const float x = o.back_a[0] * u + o.back_a[1] * v + o.back_a[2] + w * o.back_b[0];
        const float y = o.back_a[3] * u + o.back_a[4] * v + o.back_a[5] + w * o.back_b[1];
        const float z = o.back_a[6] * u + o.back_a[7] * v + o.back_a[8] + w * o.back_b[2];
        const float dx = x / z - (float)b.x[k], dy = y / z - (float)b.y, miss = std::sqrt(dx * dx + dy * dy);
        return cost + p_.consistency * (z > 0 && miss < kMaxMiss ? miss / kMaxMiss : 1);
    }

    // What the other colour has around, one and three pixels away.
    void look_around(Block& b) const {
        for (int n = 0; n < 8; ++n) {
            const int far = n < 4 ? 1 : 3, dx = kWays[n % 4][0] * far, dy = kWays[n % 4][1] * far;
            Neighbor& to = b.neighbors[n];
            to.dx = (float)dx, to.dy = (float)dy;
            EACH to.weight[k] = std::max(-std::fabs(level(b.x[k] + dx, b.y + dy) - b.level[k]) / p_.gray_scale, -80.0f);
            exponential(to.weight);
            EACH {
                const bool is = holds(b.x[k] + dx, b.y + dy);
                to.w[k] = is ? p_.planes[at(b.x[k] + dx, b.y + dy)] : 1;
                to.weight[k] = is ? to.weight[k] / 8 : 0;
            }
        }
    }

    // By how much the plane misses the neighbours' inverse depths, less where gray levels change.
    void add_smoothness(const Block& b, const Planes& h, Lane& cost) const {
        for (const Neighbor& n : b.neighbors) EACH {
                const float off = std::fabs(h.w[k] + n.dx * h.wx[k] + n.dy * h.wy[k] - n.w[k]);
                const float share = off / (p_.smooth_scale * h.w[k]);
                cost[k] += p_.smoothness * n.weight[k] * (share < 1 ? share : 1);
            }
    }

    void load(const Block& b, Planes& h) const {
        EACH {
            const float* from = p_.planes + at(b.x[k], b.y);
            h.w[k] = from[0], h.wx[k] = from[size_], h.wy[k] = from[2 * size_];
        }
    }

    void measure(Block& b) const {
        Planes h;
        Lane cost;
        load(b, h);
        match(b, h, cost);
        EACH p_.cost[at(b.x[k], b.y)] = cost[k];
    }

    void attempt(const Block& b, Planes& h, Best& best) const {
        EACH {
            h.w[k] = std::min(std::max(h.w[k], p_.min_inverse), p_.max_inverse);
            const float steepest = p_.max_slope * h.w[k];
            h.wx[k] = std::min(std::max(h.wx[k], -steepest), steepest);
            h.wy[k] = std::min(std::max(h.wy[k], -steepest), steepest);
        }
        Lane matched, total;
        match(b, h, matched);
        EACH total[k] = matched[k];
        add_smoothness(b, h, total);
        EACH {
            const bool better = total[k] < best.total[k];
            best.planes.w[k] = better ? h.w[k] : best.planes.w[k];
            best.planes.wx[k] = better ? h.wx[k] : best.planes.wx[k];
            best.planes.wy[k] = better ? h.wy[k] : best.planes.wy[k];
            best.match[k] = better ? matched[k] : best.match[k];
            best.total[k] = better ? total[k] : best.total[k];
        }
    }

    void improve(Block& b, int turn) const {
        look_around(b);
        Best best;
        load(b, best.planes);
        EACH best.total[k] = best.match[k] = p_.cost[at(b.x[k], b.y)];
        add_smoothness(b, best.planes, best.total);
        for (const auto& way : kWays) {
            Planes h;
            propagate(b, way, h);
            attempt(b, h, best);
        }
        for (int kind = 0; kind < 3; ++kind) {
            Planes h;
            vary(b, turn, kind, best.planes, h);
            attempt(b, h, best);
        }
        EACH {
            float* to = p_.planes + at(b.x[k], b.y);
            to[0] = best.planes.w[k], to[size_] = best.planes.wx[k], to[2 * size_] = best.planes.wy[k];
            p_.cost[at(b.x[k], b.y)] = best.match[k];
        }
    }

    // In one direction, the plane that matches best of those within reach (Xu & Tao 2019, Sec. 3.1, along lines only).
    void propagate(const Block& b, const int (&way)[2], Planes& h) const {
        EACH {
            int dx = 0, dy = 0;
            float least = kUnseen;
            for (int far = 1; far <= kReach && holds(b.x[k] + way[0] * far, b.y + way[1] * far); far += 2) {
                const float cost = p_.cost[at(b.x[k] + way[0] * far, b.y + way[1] * far)];
                if (cost < least) least = cost, dx = way[0] * far, dy = way[1] * far;
            }
            const float* from = p_.planes + at(b.x[k] + dx, b.y + dy);
            h.wx[k] = from[size_], h.wy[k] = from[2 * size_];
            h.w[k] = from[0] - (float)dx * h.wx[k] - (float)dy * h.wy[k];
        }
    }

    // Another inverse depth (kind 0), another slope (1), or a little of both (2); by half as much from turn to turn.
    void vary(const Block& b, int turn, int kind, const Planes& from, Planes& h) const {
        const float share = std::ldexp(1.0f, -turn), depth = (kind == 0 ? 0.1f : 0.02f) * share, slope = 0.5f * share;
        EACH {
            uint32_t state = hashed((uint32_t)at(b.x[k], b.y) ^ hashed(p_.seed + (uint32_t)(3 * turn + kind)));
            float draw[3];
            for (float& d : draw) state = hashed(state), d = (float)(state >> 8) * 0x1p-23f - 1;
            h.w[k] = from.w[k] * (kind == 1 ? 1 : 1 + depth * draw[0]);
            h.wx[k] = from.wx[k] + (kind == 0 ? 0 : slope * p_.max_slope * from.w[k] * draw[1]);
            h.wy[k] = from.wy[k] + (kind == 0 ? 0 : slope * p_.max_slope * from.w[k] * draw[2]);
        }
    }

    const StereoProblem& p_;
    const int64_t size_;
};

}  // namespace

extern "C" {

// Improves the planes of all pixels `turns` times, and tells their cost. 0 = done, 1 = out of memory.
int ss_patchmatch(const StereoProblem* problem) {
    return guarded([&] { Matcher(*problem).run(); });
}
}
