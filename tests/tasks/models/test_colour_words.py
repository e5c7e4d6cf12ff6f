import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.colors import CSS4_COLORS, to_rgb

from ss_flow.errors import InputError
from ss_flow.tasks.models.colour_words import TERMS, ColourWords, colours_in, nearest_shade, shares, words_ignored

ENCODER = ColourWords()


def top(rgb) -> str:
    return TERMS[int(shares(np.array([rgb], np.uint8)).argmax())]


@pytest.mark.parametrize(
    "rgb, term",
    [
        ((0, 0, 0), "black"),
        ((255, 255, 255), "white"),
        ((200, 20, 30), "red"),
        ((110, 15, 20), "red"),
        ((67, 8, 15), "red"),  # a curtain in the shade
        ((65, 12, 9), "red"),  # a crate against the light
        ((20, 120, 40), "green"),
        ((250, 220, 40), "yellow"),
        ((30, 60, 170), "blue"),
        ((150, 195, 235), "blue"),
        ((105, 65, 30), "brown"),
        ((60, 36, 20), "brown"),
        ((50, 25, 15), "brown"),
        ((120, 40, 150), "purple"),
        ((250, 150, 190), "pink"),
        ((250, 130, 20), "orange"),
        ((128, 128, 128), "grey"),
        ((100, 100, 100), "grey"),
    ],
)
def test_a_plain_colour_gets_its_name(rgb, term):
    assert top(rgb) == term


def test_most_css_colours_with_a_basic_term_in_their_name_get_that_term():
    named = {n: [t for t in TERMS if t.replace("grey", "gray") in n.replace("grey", "gray")] for n in CSS4_COLORS}
    named = {n: terms for n, terms in named.items() if terms}
    right = [n for n, terms in named.items() if top([round(255 * x) for x in to_rgb(CSS4_COLORS[n])]) in terms]
    assert len(named) > 60 and len(right) / len(named) > 0.65


@given(arrays(np.uint8, st.tuples(st.integers(1, 30), st.just(3))))
def test_shares_are_a_distribution(pixels):
    p = shares(pixels)
    assert (p >= 0).all() and p.sum() == pytest.approx(1)


def test_the_distance_is_that_to_the_nearest_shade():
    rng = np.random.default_rng(0)
    pixels, shades = rng.normal(size=(200, 3)), rng.normal(size=(7, 3))
    expected = [min(float(((pixel - shade) ** 2).sum()) for shade in shades) for pixel in pixels]
    assert nearest_shade(pixels, shades).tolist() == pytest.approx(expected)


def test_half_a_picture_gives_half_the_share():
    red, blue = shares(np.uint8([[255, 0, 0]])), shares(np.uint8([[0, 0, 255]]))
    both = shares(np.uint8([[255, 0, 0], [0, 0, 255]]))
    np.testing.assert_allclose(both, (red + blue) / 2)


def test_only_the_pixels_under_the_mask_count():
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, 4:] = (255, 0, 0)
    mask = np.zeros((8, 8), bool)
    mask[:, 4:] = True
    inside = ENCODER.encode_images([image], [mask])
    np.testing.assert_array_equal(inside, ENCODER.encode_images([image[:, 4:]]))
    assert TERMS[inside[0].argmax()] == "red"
    assert TERMS[ENCODER.encode_images([image], [~mask])[0].argmax()] == "black"


def test_embeddings_have_unit_length():
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (9, 7, 3), np.uint8) for _ in range(4)]
    rows = np.concatenate([ENCODER.encode_images(images), ENCODER.encode_texts(["red", "navy or teal"])])
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, rtol=1e-6)


def test_the_cosine_of_a_picture_and_a_term_is_the_root_of_the_share():
    image = np.random.default_rng(1).integers(0, 256, (5, 5, 3), np.uint8)
    cosines = ENCODER.encode_images([image]) @ ENCODER.encode_texts(TERMS).T
    np.testing.assert_allclose(cosines[0] ** 2, shares(image.reshape(-1, 3)), rtol=1e-5)


def test_a_large_picture_is_read_like_a_small_one():
    rng = np.random.default_rng(2)
    pixels = rng.choice(np.uint8([[220, 20, 20], [20, 30, 200], [240, 240, 240]]), 200_000, p=[0.6, 0.3, 0.1])
    expected = 0.6 * shares(np.uint8([[220, 20, 20]])) + 0.3 * shares(np.uint8([[20, 30, 200]]))
    expected += 0.1 * shares(np.uint8([[240, 240, 240]]))
    np.testing.assert_allclose(shares(pixels), expected, atol=0.01)


@pytest.mark.parametrize(
    "text, terms",
    [
        ("the red mug", ("red",)),
        ("RED!", ("red",)),
        ("a crimson curtain", ("red",)),
        ("navy blue bag", ("blue",)),
        ("teal", ("green",)),
        ("beige sofa", ("brown",)),
        ("gray-ish", ("grey",)),
        ("reddish", ("red",)),
        ("black and white", ("black", "white")),
        ("the coloured bed", ()),
        ("", ()),
    ],
)
def test_colours_are_found_in_a_text(text, terms):
    assert colours_in(text) == terms


def test_a_text_without_a_colour_is_refused_with_advice():
    with pytest.raises(InputError, match=r'"the mug" names no colour.*`ss-flow models list`\) and run again'):
        ENCODER.encode_texts(["the mug"])


@pytest.mark.parametrize(
    "text, words",
    [
        ("the red mug, not the blue one", ("mug",)),
        ("Crimson velvet chair and a red velvet seat", ("velvet", "chair", "seat")),
        ("something red", ()),
        ("rote Tür red", ("rote", "tür")),
    ],
)
def test_the_words_that_say_nothing_to_the_encoder_are_named_once_each(text, words):
    assert words_ignored(text) == words


def test_the_negatives_are_the_colours_that_the_text_does_not_name():
    assert set(ENCODER.negatives("red or green")) == set(TERMS) - {"red", "green"}


def test_an_empty_mask_is_an_error():
    with pytest.raises(ValueError):
        ENCODER.encode_images([np.zeros((2, 2, 3), np.uint8)], [np.zeros((2, 2), bool)])
