"""Many masks, or many lists of views, as the few arrays that artifacts keep them in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Masks:
    """Masks, each a bit a pixel of the box that it fills: things are small in their photos, and steps hold all masks of
    a scene at once."""

    sizes: Int32
    """[N, 2] width and height of each mask's view."""
    boxes: Int32
    """[N, 4] columns and rows that hold it: x0, y0, x1, y1, the last two exclusive; all 0 where it is empty."""
    packed: UInt8
    """What the boxes hold, one after the other, each row-major and filled up to a whole byte (`np.packbits`)."""

    @staticmethod
    def of(masks: Iterable[Bool]) -> Masks:
        """Masks [H, W], which may differ in size; of an iterator no more than one is held at a time."""
        sizes, boxes, packed = list[tuple[int, int]](), list[tuple[int, int, int, int]](), [np.zeros(0, np.uint8)]
        for mask in masks:
            x0, y0, x1, y1 = bounds(mask)
            sizes.append((mask.shape[1], mask.shape[0]))
            boxes.append((x0, y0, x1, y1))
            packed.append(np.packbits(mask[y0:y1, x0:x1]))
        return Masks(
            np.array(sizes, np.int32).reshape(-1, 2), np.array(boxes, np.int32).reshape(-1, 4), np.concatenate(packed)
        )

    @staticmethod
    def joined(parts: Sequence[Masks]) -> Masks:
        """Those of several, one after the other."""
        parts = [Masks.of(()), *parts]
        return Masks(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Masks)))

    def rows(self, rows: Sequence[int] | Int64) -> Masks:
        """Some of them, in this order."""
        packed = np.concatenate([np.zeros(0, np.uint8), *(self._bits(row) for row in rows)])
        return Masks(self.sizes[list(rows)], self.boxes[list(rows)], packed)

    def mask(self, row: int) -> Bool:
        """One of them: [H, W]."""
        width, height = self.sizes[row].tolist()
        mask = np.zeros((height, width), bool)
        self._draw(row, mask)
        return mask

    def areas(self) -> Int64:
        """[N] pixels of each."""
        return np.array([np.bitwise_count(self._bits(row)).sum() for row in range(len(self.boxes))], np.int64)

    def same(self, others: Masks) -> bool:
        """Whether others are these to the pixel, in this order."""
        return all(np.array_equal(getattr(self, f.name), getattr(others, f.name)) for f in fields(Masks))

    def _draw(self, row: int, empty: Bool) -> None:
        x0, y0, x1, y1 = self.boxes[row].tolist()
        bits = np.unpackbits(self._bits(row), count=(y1 - y0) * (x1 - x0))
        empty[y0:y1, x0:x1] = bits.reshape(y1 - y0, x1 - x0)

    def _bits(self, row: int) -> UInt8:
        x0, y0, x1, y1 = self.boxes[: row + 1].astype(np.int64).T
        lengths = -(-(x1 - x0) * (y1 - y0) // 8)
        end = int(lengths.sum())
        return self.packed[end - int(lengths[-1]) : end]


@dataclass(frozen=True)
class PhotoMasks(Masks):
    """Masks in one view."""

    name: str
    """Of the view."""
    height: int
    width: int

    def dense(self) -> Bool:
        """The masks as [N, H, W] booleans."""
        dense = np.zeros((len(self.boxes), self.height, self.width), bool)
        for row, empty in enumerate(dense):
            self._draw(row, empty)
        return dense


@dataclass(frozen=True)
class ViewMasks(Masks):
    """Masks of one thing, one in each of some views."""

    views: tuple[str, ...]
    """[N] names of the views that have a mask, in the order of the frames."""

    def dense(self) -> list[Bool]:
        """The masks, [H, W] each."""
        return [self.mask(row) for row in range(len(self.boxes))]


def bounds(mask: Bool) -> tuple[int, int, int, int]:
    """Columns and rows that hold a mask [H, W]: x0, y0, x1, y1, the last two exclusive; all 0 where it is empty."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return 0, 0, 0, 0
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


@dataclass(frozen=True)
class ViewLists:
    """Some of a scene's views for each row, one list after the other."""

    first: Int32
    """[R + 1] where the views of each row begin in `view`."""
    view: Int32
    """[A] places of views in the scene's order, ascending for each row."""

    def views(self, row: int) -> list[int]:
        """The views of a row."""
        found: list[int] = self.view[self.first[row] : self.first[row + 1]].tolist()
        return found

    @staticmethod
    def arrays(views: Sequence[Sequence[int]]) -> dict[str, Int32]:
        """The two arrays by their names; views: of each row, ascending."""
        first = np.append(0, np.cumsum([len(of_row) for of_row in views])).astype(np.int32)
        return {"first": first, "view": np.array([view for of_row in views for view in of_row], np.int32)}
