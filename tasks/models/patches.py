"""Networks that describe a picture patch by patch: DINOv2, or the encoder of a segmenter."""

from __future__ import annotations

import functools
from typing import Protocol

import numpy as np

from ss_flow.errors import InputError
from ss_flow.tasks.artifacts import Float32, UInt8
from ss_flow.tasks.models.catalogue import PATCHES, Model
from ss_flow.tasks.models.onnx import imagenet_input, open_session, run
from ss_flow.tasks.models.sam import Sam


class PatchEncoder(Protocol):
    """A model that gives a vector for each patch of a picture."""

    def encode(self, rgb: UInt8) -> Float32:
        """[h, w, D] of a square picture [S, S, 3] RGB; the patches fill the picture, row by row."""
        ...


class DinoV2:
    """DINOv2 (Oquab et al., "DINOv2: Learning Robust Visual Features without Supervision").

    The network: `pixel_values` [1, 3, S, S] -> [1, extra + (S / patch)², D], whose last rows are the patches.
    """

    def __init__(self, model: Model) -> None:
        """Raises InputError when the file is missing, damaged or another network."""
        self._session = open_session(model.file("network"), inputs=("pixel_values",))
        self._patch = round(model.parameter("patch"))

    def encode(self, rgb: UInt8) -> Float32:
        """[h, w, D] of a square picture, which is cut to whole patches by scaling it."""
        import cv2

        count = max(1, round(rgb.shape[0] / self._patch))
        side = count * self._patch
        scaled = np.asarray(cv2.resize(rgb, (side, side), interpolation=cv2.INTER_AREA), np.uint8)
        tokens = run(self._session, {"pixel_values": imagenet_input(scaled)})[0]
        if tokens.ndim != 3 or tokens.shape[1] < count**2:
            raise InputError(f"the network gives {list(tokens.shape)} for {count} x {count} patches: it is no DINOv2.")
        return np.asarray(tokens[0, -(count**2) :].reshape(count, count, -1), np.float32)


class SegmenterPatches:
    """What a Segment Anything network makes of a picture before any prompt: 64 x 64 vectors of 256 numbers."""

    def __init__(self, model: Model) -> None:
        """Raises InputError as `Sam` does."""
        self._sam = Sam(model)

    def encode(self, rgb: UInt8) -> Float32:
        return np.ascontiguousarray(self._sam.encode(rgb).features[0].transpose(1, 2, 0))


@functools.lru_cache(maxsize=1)
def patch_encoder_of(model: Model) -> PatchEncoder:
    """The encoder that a model's files hold, kept open for the next instance. Raises InputError."""
    return DinoV2(model) if model.kind == PATCHES else SegmenterPatches(model)
