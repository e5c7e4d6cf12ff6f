"""CLIP through ONNX Runtime (Radford et al., "Learning Transferable Visual Models From Natural Language Supervision").

The two halves are separate files, as public exports have them: pictures `pixel_values` [n, 3, S, S] -> `image_embeds`
[n, D], and texts `input_ids` [n, 77] -> `text_embeds` [n, D].
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.artifacts import Bool, Float32, UInt8
from ss_flow.tasks.models.onnx import open_session
from ss_flow.tasks.models.text_image import CANONICAL, unit_rows
from ss_flow.tasks.models.tokenizer import ClipTokenizer

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

_MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
_DEVIATION = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
_IMAGE_OUTPUTS = ("image_embeds", "image_embeddings", "image_features", "pooler_output", "output")
_TEXT_OUTPUTS = ("text_embeds", "text_embeddings", "text_features", "pooler_output", "output")
_USUAL_SIZE = 224
_BATCH = 16


class Clip:
    """A CLIP model, given by its files.

    name: what results carry. vision, text: the ONNX files. tokenizer: see `ClipTokenizer.from_files`.
    Raises InputError when a file is not a half of a CLIP model, or the halves do not fit together.
    """

    sees_masks = False
    absolute = False

    def __init__(self, name: str, vision: FileRef, text: FileRef, tokenizer: Sequence[Path]) -> None:
        self.name = name
        self._vision, self._text = open_session(vision), open_session(text)
        self._image_output = _output(self._vision, _IMAGE_OUTPUTS, vision.path)
        self._text_output = _output(self._text, _TEXT_OUTPUTS, text.path)
        self._tokenize = ClipTokenizer.from_files(*tokenizer)
        side = self._vision.get_inputs()[0].shape[-1]
        self._side = side if isinstance(side, int) else _USUAL_SIZE
        self.dimension = self.encode_texts([""]).shape[1]
        of_images = self.encode_images([np.zeros((self._side, self._side, 3), np.uint8)]).shape[1]
        if of_images != self.dimension:
            raise InputError(
                f"{vision.path.name} gives vectors of {of_images} numbers and {text.path.name} of {self.dimension}; "
                "both must come from the same CLIP model."
            )

    def encode_images(self, images: Sequence[UInt8], masks: Sequence[Bool] | None = None) -> Float32:
        """Unit vectors of pictures: [n, D].

        images: n times [h, w, 3] RGB. masks must be None: this model sees whole pictures.
        """
        if masks is not None:
            raise ValueError("CLIP sees whole pictures; compose the background before")
        rows = []
        entry = self._vision.get_inputs()[0].name
        for start in range(0, len(images), _BATCH):
            pixels = np.stack([prepare(image, self._side) for image in images[start : start + _BATCH]])
            rows.append(self._vision.run([self._image_output], {entry: pixels})[0])
        return unit_rows(np.concatenate(rows)) if rows else np.zeros((0, self.dimension), np.float32)

    def encode_texts(self, texts: Sequence[str]) -> Float32:
        """Unit vectors of texts: [n, D]."""
        if not texts:
            return np.zeros((0, self.dimension), np.float32)
        ids = self._tokenize(texts)
        feeds = {}
        for entry in self._text.get_inputs():
            values = np.ones_like(ids) if "mask" in entry.name else ids
            feeds[entry.name] = values.astype(np.int32 if "int32" in entry.type else np.int64)
        return unit_rows(self._text.run([self._text_output], feeds)[0])

    def negatives(self, text: str) -> tuple[str, ...]:
        """The canonical phrases."""
        return CANONICAL


def prepare(image: UInt8, side: int) -> Float32:
    """CLIP's preprocessing: the shorter side to `side` pixels (bicubic), the central square, mean and deviation.

    image: [h, w, 3] RGB. Returns [3, side, side].
    """
    import cv2

    h, w = image.shape[:2]
    scale = side / min(h, w)
    size = max(side, round(w * scale)), max(side, round(h * scale))
    if (w, h) != size:
        # Cubic interpolation alone skips pixels when it shrinks; averaging first to below twice the size avoids that.
        if scale < 0.5:
            image = np.asarray(cv2.resize(image, (size[0] * 2, size[1] * 2), interpolation=cv2.INTER_AREA), np.uint8)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    top, left = (size[1] - side) // 2, (size[0] - side) // 2
    square = image[top : top + side, left : left + side].astype(np.float32) / 255
    return np.ascontiguousarray(((square - _MEAN) / _DEVIATION).transpose(2, 0, 1))


def _output(session: InferenceSession, known: Sequence[str], file: Path) -> str:
    names = [output.name for output in session.get_outputs()]
    found = [name for name in known if name in names]
    if not found:
        raise InputError(f"{file.name} has the outputs {', '.join(names)}; one of {', '.join(known)} is needed.")
    return found[0]
