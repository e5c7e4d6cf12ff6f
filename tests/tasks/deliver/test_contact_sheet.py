import numpy as np
import pytest

from ss_flow.tasks.deliver.contact_sheet import caption, contact_sheet, table_picture

RED, GREEN, BLUE = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def plain(color, height: int = 60, width: int = 80) -> np.ndarray:
    return np.full((height, width, 3), color, np.uint8)


def box_of(sheet: np.ndarray, color) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero((sheet == color).all(axis=2))
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_pictures_stand_in_rows_in_their_order():
    sheet = contact_sheet([plain(RED), plain(GREEN), plain(BLUE)], columns=2, width=430)
    red, green, blue = (box_of(sheet, color) for color in (RED, GREEN, BLUE))
    assert red[1] == green[1] and red[2] < green[0]
    assert blue[0] == red[0] and blue[1] >= red[3]
    assert sheet.shape[1] == 430 and red[2] - red[0] == 200 and red[3] - red[1] == 150


def test_a_picture_of_another_shape_keeps_its_proportions():
    sheet = contact_sheet([plain(RED), plain(GREEN, 100, 50), plain(BLUE)], columns=3, width=640)
    x0, y0, x1, y1 = box_of(sheet, GREEN)
    assert (y1 - y0) / (x1 - x0) == pytest.approx(2, abs=0.1)


def test_captions_are_written_below():
    without = contact_sheet([plain(RED)] * 2, columns=2, width=400)
    with_text = contact_sheet([plain(RED)] * 2, ["a", "b"], columns=2, width=400)
    assert with_text.shape[0] > without.shape[0]
    assert with_text[box_of(with_text, RED)[3] :].min() < 120


def test_a_long_caption_is_cut():
    assert caption("x" * 500, 200).shape == (26, 200, 3)


def test_text_with_dollar_signs_is_not_taken_for_formulas():
    assert caption("$x_1^", 200).shape == (26, 200, 3)
    assert table_picture("$_{", [("$a^", "1")]).shape[2] == 3


@pytest.mark.parametrize("pictures, captions", [([], []), ([plain(RED)], ["a", "b"])])
def test_a_sheet_needs_pictures_and_as_many_captions(pictures, captions):
    with pytest.raises(ValueError, match="make no sheet"):
        contact_sheet(pictures, captions)


def test_a_table_grows_with_its_rows_up_to_a_limit():
    heights = [table_picture("t", [("a", "1")] * n).shape[0] for n in (1, 5, 40, 900)]
    assert heights[0] < heights[1] < heights[2] == heights[3]
    assert table_picture("t", []).min() < 200
