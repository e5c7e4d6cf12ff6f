"""Segment Anything: masks from point prompts on one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ss_flow.running import warn
from ss_flow.task import Bundle
from ss_flow.tasks.artifacts import Bool, Float32, Float64, Frame, Int32, UInt8
from ss_flow.tasks.geometry.noise import noise_of, without_noise
from ss_flow.tasks.models.catalogue import Model
from ss_flow.tasks.models.onnx import open_session, run
from ss_flow.tasks.models.sam_cells import SIDE
from ss_flow.tasks.models.sam_decoder import FINE, MASKS, MaskDecoder, open_decoder

FRAME = 1024
"""Side of the square frame that the network sees, in pixels."""
LOW = SIDE * FINE
"""Side of a mask of the whole frame, in its pixels."""
_MEAN = np.array([123.675, 116.28, 103.53], np.float32)
_DEVIATION = np.array([58.395, 57.12, 57.375], np.float32)


@dataclass(frozen=True)
class Embedding:
    """What the encoder makes of one image; every prompt on the image starts from it."""

    features: Float32
    """[1, 256, 64, 64]."""
    height: int
    width: int
    """Size of the image as the network saw it, in pixels."""
    turns: int = 0
    """Quarter turns, counterclockwise, by which the image was turned before."""

    @property
    def scale(self) -> float:
        """Pixels of the network's frame per pixel of the image."""
        return FRAME / max(self.height, self.width)

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of the network's cells that show the image, in part at least."""
        rows, columns = (-(-round(side * self.scale) * SIDE // FRAME) for side in (self.height, self.width))
        return rows, columns

    def upsample(self, logits: Float32) -> Float32:
        """Logits at the size of the image, bilinear: [M, h, w] -> [M, H, W].

        They begin at the image's upper left corner, and 256 of their pixels are as long as its longer side.
        """
        import cv2

        step = self.scale * LOW / FRAME
        # Pixel centres: x_low + 0.5 = (x + 0.5) * step.
        inverse = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2]])
        result = np.empty((len(logits), self.height, self.width), np.float32)
        for index, mask in enumerate(logits):
            result[index] = cv2.warpAffine(
                mask,
                inverse,
                (self.width, self.height),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
        return result


@dataclass(frozen=True)
class EmbeddedPhoto(Bundle):
    """A photo and the segmenter's embedding of it: what a prompt needs."""

    frame: Frame
    embedding: Embedding


class Sam:
    """A Segment Anything network of the catalogue."""

    def __init__(self, model: Model) -> None:
        """Open the two networks. Raises InputError when a file is missing, damaged or another network."""
        self.name = model.name
        self._encoder = open_session(model.file("encoder"), inputs=("input",))
        self._decoder = open_decoder(model.file("decoder"), model.names_inside)

    def encode(self, rgb: UInt8, turns: int = 0, noise: float = 0.0) -> Embedding:
        """The embedding of an image [H, W, 3] uint8, turned first by so many quarters counterclockwise.

        noise: of 255 grey values; what has more of it is smoothed before; 0: nothing is.
        """
        import cv2

        rgb = np.rot90(rgb, turns)
        height, width = rgb.shape[:2]
        scale = FRAME / max(height, width)
        inner_height, inner_width = round(height * scale), round(width * scale)
        seen = rgb
        if scale < 1:  # which takes noise away, too
            seen = cv2.resize(rgb, (inner_width, inner_height), interpolation=cv2.INTER_AREA)
        if noise and noise_of(seen) > noise:
            warn("Photos are noisy: the segmenter sees them smoothed. split.noise=0 shows them as they are.")
            seen = without_noise(seen)
        if scale >= 1:
            seen = cv2.resize(seen, (inner_width, inner_height), interpolation=cv2.INTER_LINEAR)
        padded = np.zeros((1, 3, FRAME, FRAME), np.float32)
        padded[0, :, :inner_height, :inner_width] = ((seen - _MEAN) / _DEVIATION).transpose(2, 0, 1)
        return Embedding(run(self._encoder, {"input": padded})[0], height, width, turns)

    def image(self, embedding: Embedding, *, few: bool = False) -> PromptedImage:
        """An image that prompts ask on.

        few: for a prompt or two, or prompts of ten points, which do not gain by what is computed for all of them first.
        """
        return PromptedImage(self._decoder, embedding, few)


class PromptedImage:
    """An image, and what all prompts on it have in common.

    There are four masks for each prompt: 0 is the one for prompts of several points, 1 to 3 are the alternatives (part,
    whole, group) for an ambiguous single point.
    """

    BATCH = 8
    """Prompts a run; more of them cost memory and save no time."""

    def __init__(self, decoder: MaskDecoder, embedding: Embedding, few: bool) -> None:
        self._decoder, self._embedding = decoder, embedding
        self._known = decoder.known(embedding.features, few=few)

    def predict(self, points: Float32 | Float64, labels: Int32 | None = None) -> tuple[Float32, Float32]:
        """The four masks of each of M single-point prompts.

        points: [M, 2] x, y in pixels of the image as the network saw it. labels: [M] 1 = inside (the default), 0 =
        outside.
        Returns logits: [M, 4, h, w] (see `Embedding.upsample`), predicted_iou: [M, 4].
        """
        if labels is None:
            labels = np.ones(len(points), np.int32)
        parts = [
            self._decode(points[start : start + self.BATCH, None], labels[start : start + self.BATCH, None])
            for start in range(0, len(points), self.BATCH)
        ]
        if not parts:
            rows, columns = self._embedding.cells
            return np.zeros((0, MASKS, rows * FINE, columns * FINE), np.float32), np.zeros((0, MASKS), np.float32)
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def predict_prompt(self, points: Float32 | Float64, labels: Int32 | None = None) -> tuple[Bool, float]:
        """The one mask that several points ask for together.

        points: [n, 2] x, y in pixels of the image before it was turned, n >= 1. labels: [n] 1 = inside (the default),
        0 = outside, 2 and 3 = corners of a box round it, upper left and lower right once it is turned.
        Returns the mask [H, W] of the image before it was turned, and its predicted IoU. A single point is ambiguous
        and gets the best of the alternatives; several points get the mask made for them.
        """
        if labels is None:
            labels = np.ones(len(points), np.int32)
        logits, scores = self._decode(self._turned(points)[None], labels[None])
        best = 1 + int(np.argmax(scores[0, 1:])) if len(points) == 1 else 0
        mask = self._embedding.upsample(logits[0, best : best + 1])[0] > 0
        return np.rot90(mask, -self._embedding.turns), float(scores[0, best])

    def _turned(self, points: Float32 | Float64) -> Float32 | Float64:
        """Where points of the image lie in it once it is turned."""
        seen = self._embedding
        if not seen.turns:
            return points
        x, y = points.T
        places = {1: (y, seen.height - x), 2: (seen.width - x, seen.height - y), 3: (seen.width - y, x)}[seen.turns]
        return np.stack(places, axis=1)

    def _decode(self, points: Float32 | Float64, labels: Int32) -> tuple[Float32, Float32]:
        places = np.asarray(points, np.float64) * self._embedding.scale
        return self._decoder(self._known, (places + 0.5) / FRAME, labels, *self._embedding.cells)
