"""One vector for each instance: what a text-image encoder sees of it (Split&Splat, Sec. 5.2; spec rows 38-40)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ss_flow.errors import InputError
from ss_flow.running import progress
from ss_flow.task import Resources, task
from ss_flow.tasks.artifacts import Bool, Descriptors, Frame, InstanceMasks, PartDescriptors, PartMasks, UInt8
from ss_flow.tasks.geometry.images import shared_rgb
from ss_flow.tasks.masks.erosion import ErosionParams, erode
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import network_identity
from ss_flow.tasks.packed import bounds
from ss_flow.tasks.ranges import Count, Fraction, Natural, Positive
from ss_flow.tasks.semantics.encoders import encoder_of
from ss_flow.tasks.semantics.sides import mean_direction
from ss_flow.tasks.unread import by_default


@dataclass(frozen=True)
class DescribeParams:
    """How the pictures of an instance are cut out."""

    background: Literal["blur", "black", "white"] = "blur"
    """What takes the place of the pixels around the instance; without effect for an encoder that sees masks."""
    blur_radius: Positive = 10.0
    """Standard deviation of the blur, pixels of the photo."""
    margin_px: Natural = 10
    """Pixels added on every side of the square box around the mask."""
    box_scale: Positive = 1.05
    """Factor on the side of that box."""
    crop_side: Count = 224
    """Side of the picture that the encoder gets, pixels."""
    max_views: Count = 10
    """How many views go in, those with the largest masks first."""
    min_area: Fraction = 0.002
    """Share of the image that a mask must cover for its view to go in."""
    weighted: bool = True
    """Whether views weigh in by their visible area; False takes the plain mean, as in the paper."""
    erosion: ErosionParams = ErosionParams()
    """How much of the mask's border is left out."""

    def in_use(self, encoder: Model | None) -> DescribeParams:
        """With what is not read as by default, so that it does not enter the key: colour words (None) see masks."""
        if encoder is None:
            return by_default(self, "background", "blur_radius", "margin_px", "box_scale", "crop_side")
        return self if self.background == "blur" else by_default(self, "blur_radius")


@task(resources=Resources(cores=1, memory_mb=1200, gpus=0.1), environment=network_identity)
def describe(
    frames: tuple[Frame, ...],
    instance: InstanceMasks | PartMasks,
    *,
    encoder: Model | None = None,
    params: DescribeParams = DescribeParams(),
    turns: int = 0,
) -> Descriptors:
    """An instance's pictures, or a part's, as unit vectors, and their mean, brought back to unit length.

    frames: at least those with a mask of the instance. encoder: None for colour words. turns: by how many quarters,
    counterclockwise, pictures are turned to stand upright.
    Returns zeros and no views when no mask covers `min_area` of its image, or erosion leaves nothing of those that do.
    Raises InputError when a frame's size is not that of the masks.
    """
    model = encoder_of(encoder)
    by_name = {frame.name: i for i, frame in enumerate(frames)}
    area = instance.areas()
    large = np.argsort(-area, kind="stable")[: params.max_views]
    least = np.maximum(1, params.min_area * instance.sizes.prod(axis=1))
    chosen = np.sort(large[(area >= least)[large]])
    vectors, used = [], []
    for done, row in enumerate(chosen):
        frame = frames[by_name[instance.views[row]]]
        width, height = instance.sizes[row]
        if (frame.height, frame.width) != (height, width):
            raise InputError(
                f"Frame {frame.name} is {frame.width} x {frame.height} pixels and the mask of instance "
                f"{instance.instance_id} has {width} x {height}; both must have one size."
            )
        mask = erode(instance.mask(row), params.erosion)
        if not mask.any():
            continue
        used.append(row)
        image = shared_rgb(frame)
        if model.sees_masks:
            x0, y0, x1, y1 = bounds(mask)
            vectors.append(model.encode_images([image[y0:y1, x0:x1]], [mask[y0:y1, x0:x1]])[0])
        else:
            vectors.append(model.encode_images([np.rot90(crop(image, mask, params), turns)])[0])
        progress(done + 1, len(chosen), frame.name)
    of_views = np.array(vectors, np.float32).reshape(len(used), model.dimension)
    weights = (area[used] if params.weighted else np.ones(len(used))).astype(np.float32)
    embedding = mean_direction(of_views, weights)
    views = tuple(instance.views[row] for row in used)
    return Descriptors(instance.instance_id, embedding, views, weights, model.name, of_views)


@task(resources=Resources(cores=1, memory_mb=1200), environment=network_identity)
def describe_part(
    frames: tuple[Frame, ...],
    part: PartMasks,
    *,
    encoder: Model | None = None,
    params: DescribeParams = DescribeParams(),
    turns: int = 0,
) -> PartDescriptors:
    """What `describe` says of a part of an instance."""
    found = describe(frames, part, encoder=encoder, params=params, turns=turns)
    return PartDescriptors(**vars(found), part_id=part.part_id)


def crop(image: UInt8, mask: Bool, params: DescribeParams) -> UInt8:
    """The square around a mask with all else blurred or painted over: [crop_side, crop_side, 3].

    image: [H, W, 3]; mask: [H, W], not empty. Where the square leaves the image, its border pixels repeat.
    """
    import cv2

    x0, y0, x1, y1 = bounds(mask)
    side = max(x1 - x0, y1 - y0) + 2 * params.margin_px
    side = round(side * params.box_scale)
    left, top = (x0 + x1 - side) // 2, (y0 + y1 - side) // 2
    rows = np.clip(np.arange(top, top + side), 0, image.shape[0] - 1)
    columns = np.clip(np.arange(left, left + side), 0, image.shape[1] - 1)
    inside = np.outer((rows == np.arange(top, top + side)), (columns == np.arange(left, left + side)))
    square, keep = image[np.ix_(rows, columns)], mask[np.ix_(rows, columns)] & inside
    if params.background == "blur":
        around = cv2.GaussianBlur(square, (0, 0), params.blur_radius)
    else:
        around = np.full_like(square, 255 if params.background == "white" else 0)
    composed = np.where(keep[..., None], square, around)
    shrinks = side > params.crop_side
    size = (params.crop_side, params.crop_side)
    scaled = cv2.resize(composed, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return np.asarray(scaled, np.uint8)
