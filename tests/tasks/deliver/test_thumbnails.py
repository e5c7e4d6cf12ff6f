"""Small pictures of objects: cut out of the view that shows most of them."""

from __future__ import annotations

import numpy as np

from ss_flow.tasks.artifacts import Frame, LabelMap
from ss_flow.tasks.deliver.compressed import decompressed
from ss_flow.tasks.deliver.thumbnails import thumbnails
from ss_flow.tasks.geometry.images import encode_png

COLORS = ((200, 30, 30), (30, 30, 200))


def _views() -> tuple[list[Frame], list[LabelMap]]:
    """Two views of one colour each; instance 1 is larger in the second, 2 lies at the first one's corner."""
    frames, maps = [], []
    for name, color in zip("ab", COLORS, strict=True):
        photo = np.full((40, 60, 3), color, np.uint8)
        frames.append(Frame(name, 60, 40, encode_png(photo), np.zeros(0, np.uint8), 60, 40))
        maps.append(LabelMap(name, np.zeros((40, 60), np.uint16)))
    maps[0].ids[5:10, 5:10] = 1
    maps[0].ids[30:40, 50:60] = 2
    maps[1].ids[10:30, 10:40] = 1
    return frames, maps


def test_an_object_is_shown_in_its_best_view_with_its_surroundings_faded() -> None:
    found = thumbnails(*_views())
    pictures = {one.instance_id: decompressed(one.content) for one in found}
    assert list(pictures) == [1, 2] and all(one.shape == (128, 128, 3) for one in pictures.values())
    assert np.abs(pictures[1][64, 64].astype(int) - COLORS[1]).max() <= 1
    faded = pictures[1][64, 2].astype(int)
    assert faded.min() > 180 and np.abs(faded - (255 - 0.3 * (255 - np.array(COLORS[1])))).max() < 3


def test_beyond_the_photos_border_a_picture_is_white() -> None:
    picture = decompressed(thumbnails(*_views())[1].content)
    assert picture[-2:].min() > 250 and picture[:, -2:].min() > 250
    assert np.abs(picture[64, 64].astype(int) - COLORS[0]).max() <= 2
    turned = decompressed(thumbnails(*_views(), turns=1)[1].content)
    assert turned[:2].min() > 250 and turned[:, -2:].min() > 250 and turned[-2:, 64].min() < 250


def test_an_instances_share_is_of_all_pixels_of_all_views() -> None:
    assert [one.share for one in thumbnails(*_views())] == [(25 + 600) / 4800, 100 / 4800]
