// Differentiable rasterizer of 3D Gaussians (3D Gaussian Splatting, Kerbl et al. 2023, Sec. 4-6). No global state: any
// number of calls may run side by side, each with a workspace of its own. The number of threads changes no byte.

#include "blending.h"
#include "workspace.h"

namespace {

using binning::Band;
using binning::Frame;
using binning::kBandRows;
using binning::kChunk;
using binning::Range;
using binning::Splat;
using blending::Labels;
using lanes::splat;
using lanes::V16;

void forward(const Scene& s, const Frame& frame, Band& band, const Images& out) {
    const bool winners = out.top != nullptr;
    if (out.masks)
        (winners ? blending::forward<Labels::masks, true> : blending::forward<Labels::masks, false>)(s, frame, band, out);
    else if (out.mismatch)
        (winners ? blending::forward<Labels::mismatch, true>
                 : blending::forward<Labels::mismatch, false>)(s, frame, band, out);
    else
        (winners ? blending::forward<Labels::none, true> : blending::forward<Labels::none, false>)(s, frame, band, out);
}

// The sums of 16 candidates over their bands, from the top down, to the gradients of their parameters.
void reduce(const Scene& s, const projection::View& view, const Frame& frame, int64_t begin, int count,
            const Gradients& out) {
    Rows rows;
    rows.count = count;
    V16 v[16], color[3];
    alignas(64) float shown[3][16];
    for (int k = 0; k < 16; ++k) {
        const int64_t candidate = begin + std::min(k, count - 1);
        const Splat& p = frame.candidates[candidate];
        const Range blocks = frame.rows[candidate];
        rows.at[k] = p.row;
        v[k] = splat(0);
        for (int b = blocks.first / kBandRows; b <= blocks.last / kBandRows; ++b)
            v[k] = v[k] + lanes::load(frame.bands[b].sums[frame.places[frame.place_first[candidate] + b]].value);
        for (int c = 0; c < 3; ++c) shown[c][k] = p.color[c];
    }
    lanes::transpose(v);
    for (int c = 0; c < 3; ++c) color[c] = lanes::where_less(splat(0), lanes::load(shown[c]), v[6 + c], splat(0));
    projection::backproject(s, view, rows, {v[0], v[1], v[2], v[3], v[4], v[5], {color[0], color[1], color[2]}, v[9]},
                            out);
}

}  // namespace

extern "C" {

// The digest of the sources that this was built from (setup.py).
const char* ss_sources() { return SS_SOURCES; }

// Memory for a rendering and its gradient, reused by the next; null when there is none.
void* ss_workspace() {
    try {
        return new Workspace;
    } catch (const std::exception&) {
        return nullptr;
    }
}

void ss_workspace_free(void* workspace) { delete static_cast<Workspace*>(workspace); }

// How many (splat, block) pairs the last rendering blended: what its time grows with.
int64_t ss_entries(const void* workspace) {
    const Frame& frame = static_cast<const Workspace*>(workspace)->frame;
    int64_t sum = 0;
    for (int b = 0; b < frame.num_bands; ++b)
        for (int64_t k = 0; k < (int64_t)frame.bands[b].rows * frame.blocks_x; ++k) sum += frame.bands[b].used[k];
    return sum;
}

// Renders; the images and per-Gaussian arrays are the caller's, masks zeroed. 0 = done, 1 = out of memory.
int ss_rasterize(void* workspace, const Scene* scene, const Images* images, int threads) {
    return guarded([&] {
        const Scene& s = *scene;
        Frame& frame = static_cast<Workspace*>(workspace)->frame;
        binning::prepare(s, frame);
        const projection::View view = projection::view_of(s);
        parallel::each(threads, frame.chunks,
                       [&](int64_t c) { binning::project_chunk(s, view, c, images->radii, frame); });
        binning::allot(frame);
        parallel::each(threads, frame.chunks, [&](int64_t c) { binning::distribute(c, frame); });
        parallel::each(threads, frame.num_bands, [&](int64_t b) {
            binning::fill(frame.bands[b], frame);
            forward(s, frame, frame.bands[b], *images);
        });
        if (!images->strongest) return;
        std::fill(images->strongest, images->strongest + s.count, 0.0f);
        for (int b = 0; b < frame.num_bands; ++b)
            for (int64_t k = 0; k < frame.bands[b].count; ++k) {
                float& most = images->strongest[frame.bands[b].splats[k].row];
                most = std::fmax(most, frame.bands[b].strongest[k]);
            }
    });
}

// Finds how much each Gaussian shows in the pixels of each id >= 0 of [H, W]: the sums of its weights, in `count` pieces
// that `ss_take_shares` gives. The workspace must still hold this scene's rendering. 0 = done, 1 = out of memory.
int ss_shares(void* workspace, const Scene* scene, const int32_t* ids, int64_t* count, int threads) {
    return guarded([&] {
        Frame& frame = static_cast<Workspace*>(workspace)->frame;
        parallel::each(threads, frame.num_bands,
                       [&](int64_t b) { blending::weigh(*scene, frame, frame.bands[b], ids); });
        *count = 0;
        for (int b = 0; b < frame.num_bands; ++b) *count += (int64_t)frame.bands[b].shares.size();
    });
}

// The rows, ids and sums of these pieces, from the upper to the lower bands, in which a row may be again.
void ss_take_shares(const void* workspace, int32_t* rows, int32_t* ids, float* weights) {
    const Frame& frame = static_cast<const Workspace*>(workspace)->frame;
    for (int b = 0; b < frame.num_bands; ++b)
        for (const binning::Share& share : frame.bands[b].shares) {
            *rows++ = frame.bands[b].splats[share.splat].row;
            *ids++ = share.id;
            *weights++ = share.weight;
        }
}

// Writes the gradients of all rows; the workspace must still hold this scene's rendering. 0 = done, 1 = out of memory.
int ss_rasterize_backward(void* workspace, const Scene* scene, const Images* images, const Images* towards,
                          const Gradients* out, int threads) {
    return guarded([&] {
        const Scene& s = *scene;
        Frame& frame = static_cast<Workspace*>(workspace)->frame;
        const auto backward = towards->masks      ? blending::backward<Labels::masks>
                              : towards->mismatch ? blending::backward<Labels::mismatch>
                                                  : blending::backward<Labels::none>;
        struct Background {
            float value[3];
        };
        std::vector<Background> background(frame.num_bands);
        parallel::each(threads, frame.num_bands,
                       [&](int64_t b) { backward(s, frame, frame.bands[b], *images, *towards, background[b].value); });
        for (int c = 0; c < 3; ++c) {
            out->background[c] = 0;
            for (const Background& b : background) out->background[c] += b.value[c];
        }
        const projection::View view = projection::view_of(s);
        parallel::each(threads, frame.chunks, [&](int64_t chunk) {
            const int64_t begin = chunk * kChunk, count = std::min(kChunk, s.count - begin);
            const struct {
                float* to;
                int width;
            } arrays[] = {{out->means, 3}, {out->quaternions, 4}, {out->log_scales, 3}, {out->opacity_logits, 1},
                          {out->sh, 3 * s.sh_coefficients}, {out->centers, 2}};
            for (const auto& a : arrays) std::fill_n(a.to + begin * a.width, count * a.width, 0.0f);
            const int seen = frame.chunk_count[chunk];
            for (int k = 0; k < seen; k += 16) reduce(s, view, frame, begin + k, std::min(16, seen - k), *out);
        });
    });
}
}
