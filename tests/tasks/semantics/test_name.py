import numpy as np
from labelled_points import labels_of

from ss_flow.tasks.artifacts import Descriptors
from ss_flow.tasks.models.colour_words import ColourWords
from ss_flow.tasks.semantics import name as module
from ss_flow.tasks.semantics.name import InstanceNames, given_names, name


def descriptor(instance_id: int, embedding, encoder: str) -> Descriptors:
    vector = np.asarray(embedding, np.float32)
    no_views = np.zeros(0, np.float32), encoder, np.zeros((0, len(vector)), np.float32)
    return Descriptors(instance_id, vector, (), *no_views)


def test_colour_words_name_objects_by_their_colour():
    words = ColourWords().encode_texts(["blue", "red"])
    described = (descriptor(4, words[0], "colour words"), descriptor(2, np.zeros(11), "colour words"))
    found = name(described)
    assert found.names == ("blue object", "object")
    assert found.instance_id.tolist() == [4, 2]
    np.testing.assert_allclose(found.score, [1, 0])


def test_an_encoder_of_things_names_them_from_the_vocabulary(monkeypatch):
    class Two:
        name, dimension = "two", 2

        def encode_texts(self, texts):
            return np.array([{"mug": (1, 0), "sofa": (0, 1)}[text] for text in texts], np.float32)

    monkeypatch.setattr(module, "encoder_of", lambda files: Two())
    found = name((descriptor(1, (0.6, 0.8), "two"),), vocabulary=("mug", "sofa"))
    assert found.names == ("sofa",) and found.encoder == "two"


def test_no_instances_have_no_names():
    assert name(()).names == ()


def test_an_instance_is_called_what_the_user_calls_the_object_that_it_is():
    """Instance 7 is most of the mug, 8 a chip of it; 9 holds the fork and, more of it, the knife; nobody clicked 5."""
    labels = np.array([7] * 5 + [8] * 2 + [9] * 5 + [5] + [0] * 3, np.int32)
    objects = np.array([1] * 7 + [2] * 2 + [3] * 3 + [0] + [4] * 3, np.int32)
    words = ("red", "red", "blue", "green")
    names = InstanceNames(np.array([5, 7, 8, 9], np.int32), words, np.ones(4, np.float32), "colour words")
    found = given_names(names, labels_of(objects), labels_of(labels), objects=("my mug", "fork", "knife", "unseen"))
    assert found.names == ("red", "my mug", "blue", "knife")
    assert found.given.tolist() == [7, 9]
    assert (found.encoder, found.instance_id.tolist()) == ("colour words", [5, 7, 8, 9])


def test_an_object_whose_instance_was_left_out_names_nothing():
    names = InstanceNames(np.zeros(0, np.int32), (), np.zeros(0, np.float32), "colour words")
    found = given_names(names, labels_of(np.ones(3, np.int32)), labels_of(np.ones(3, np.int32)), objects=("mug",))
    assert found.names == () and len(found.given) == 0
