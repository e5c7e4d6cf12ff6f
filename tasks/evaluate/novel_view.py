"""Novel-view evaluation: renders of held-out views against their photos (spec 2.3)."""

from __future__ import annotations

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import (
    Bool,
    Cameras,
    ColourTransform,
    Float32,
    Float64,
    Frame,
    Gaussians,
    Metrics,
    UInt8,
)
from ss_flow.tasks.evaluate.neighbour_colours import NeighbourColours
from ss_flow.tasks.gaussians.rasterize import backend_identity
from ss_flow.tasks.geometry.cameras import Camera, camera_of
from ss_flow.tasks.geometry.images import decode_rgb, decode_valid
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.lpips import distance, lpips_of
from ss_flow.tasks.models.onnx import network_identity

_SIGMA = 1.5
_RADIUS = 5
_C1, _C2 = 0.01**2, 0.03**2
_PSNR_OF_EQUALS = 100.0
"""dB given where two images agree exactly, so that a mean over views stays finite."""


def identity() -> dict[str, str]:
    """What comparing renderings with photos depends on besides its inputs."""
    return network_identity() | backend_identity()


@task(resources=Resources(cores=1, memory_mb=1500, gpus=0.1), environment=identity)
def novel_view(
    frames_held_out: tuple[Frame, ...],
    cameras_held_out: Cameras,
    scene: Gaussians,
    cameras_trained: tuple[Camera, ...] = (),
    colours: tuple[ColourTransform, ...] = (),
    *,
    perception: Model | None = None,
) -> Metrics:
    """Render the scene from the held-out cameras and compare with the photos, as 8-bit images.

    colours: what the photos that were trained on went through, one each of `cameras_trained`.
    perception: the network of LPIPS. Pixels that a frame's `valid` mask excludes count in no measure.
    Returns psnr (dB) and ssim, and psnr_colour_fitted, the PSNR after `colour_fitted`; where photos went through
    transforms, psnr_neighbour_colours, in the colours that `NeighbourColours` expects; with a network lpips, and
    lpips_unscaled, that of pictures 0..1 (see `Lpips.differences`); each the mean over the views.
    Raises InputError when there is no view, when frames and cameras do not belong together, or when a view has no valid
    pixel.
    """
    from ss_flow.tasks.gaussians.render import render

    names = tuple(f.name for f in frames_held_out)
    if not names:
        raise InputError("There is no held-out view; at least one is needed to evaluate novel views.")
    if names != cameras_held_out.names:
        raise InputError("The held-out frames and cameras are not the same views in the same order.")
    changed = any(one.reference for one in colours)
    beside = NeighbourColours.of(scene, cameras_trained, colours) if changed else None
    found: list[dict[str, float]] = []
    for view, frame in enumerate(frames_held_out):
        valid = decode_valid(frame)
        if not valid.any():
            raise InputError(f"The mask of held-out view {frame.name} leaves no pixel to compare; drop the view.")
        camera = camera_of(cameras_held_out, view).scaled(frame.width, frame.height)
        rgb, photo = render(scene, camera).rgb, decode_rgb(frame)
        image, fitted = to_8bit(rgb), to_8bit(colour_fitted(np.clip(rgb, 0, 1), photo, valid))
        found.append(
            {
                "psnr": psnr(image, photo, valid),
                "ssim": ssim(image, photo, valid),
                "psnr_colour_fitted": psnr(fitted, photo, valid),
            }
        )
        if beside is not None:
            expected = to_8bit(beside.applied(rgb, frame.name, scene, camera))
            found[-1]["psnr_neighbour_colours"] = psnr(expected, photo, valid)
        if perception is not None:
            for name, lowest in (("lpips", -1.0), ("lpips_unscaled", 0.0)):
                found[-1][name] = distance(perceived(image, photo, valid, perception, lowest=lowest), valid)
        progress(view + 1, len(names), frame.name)
    return Metrics({name: float(np.mean([values[name] for values in found])) for name in found[0]})


def colour_fitted(image: Float32, photo: UInt8, valid: Bool) -> Float32:
    """An image with the colours of its photo: the affine map of RGB that brings it nearest (least squares).

    A scene cannot know the exposure and white balance of a view that was kept back. Where these change, a PSNR measures
    them as well, and is told after such a fit too (RawNeRF, Mildenhall et al. 2022; gsplat's cc_psnr).
    image: [H, W, 3] float, 0..1; photo: [H, W, 3]; valid: [H, W] the pixels that are fitted.
    """
    seen = np.concatenate([image[valid], np.ones((int(valid.sum()), 1), np.float32)], axis=1).astype(np.float64)
    fit = np.linalg.lstsq(seen, photo[valid] / 255, rcond=None)[0]
    return (image @ fit[:3] + fit[3]).astype(np.float32)


def to_8bit(image: Float32) -> UInt8:
    """An image as it would be saved. image: [..., 3] float, 0..1, clipped."""
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)


def psnr(image: UInt8, reference: UInt8, valid: Bool | None = None) -> float:
    """Peak signal-to-noise ratio in dB: -10 log10 of the mean squared error over all channels, peak 1.

    image, reference: [H, W, 3]; valid: [H, W] the pixels that count. Images that agree exactly give 100 dB.
    """
    error = ((image.astype(np.float64) - reference) / 255) ** 2
    mse = float(error.mean() if valid is None else error[valid].mean())
    return min(-10 * float(np.log10(mse)), _PSNR_OF_EQUALS) if mse > 0 else _PSNR_OF_EQUALS


def ssim(image: UInt8, reference: UInt8, valid: Bool | None = None) -> float:
    """Structural similarity (Wang et al., IEEE TIP 2004): 11 x 11 Gaussian window, sigma 1.5, data range 1.

    Per channel, black beyond the border, mean over pixels and channels, as the 3DGS literature computes it.
    image, reference: [H, W, 3]; valid: [H, W] the pixels that count; the others agree by definition, so that what a
    render shows there does not reach its neighbours.
    """
    a, b = (x.astype(np.float64) / 255 for x in (image, reference))
    if valid is not None:
        a = np.where(valid[..., None], a, b)
    mean_a, mean_b = _blurred(a), _blurred(b)
    var_a, var_b = _blurred(a * a) - mean_a**2, _blurred(b * b) - mean_b**2
    covariance = _blurred(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    similarity /= (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    return float(similarity.mean() if valid is None else similarity[valid].mean())


def perceived(
    image: UInt8, reference: UInt8, valid: Bool, perception: Model, *, lowest: float = -1.0
) -> tuple[Float32, ...]:
    """Where two pictures look different, as `Lpips.differences`; what is not valid agrees by definition, as for `ssim`.

    image, reference: [H, W, 3]; valid: [H, W]. Raises InputError when the pictures are too small for the network.
    """
    return lpips_of(perception).differences(np.where(valid[..., None], image, reference), reference, lowest=lowest)


def _blurred(image: Float64) -> Float64:
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(image, _SIGMA, mode="constant", radius=_RADIUS, axes=(0, 1))
