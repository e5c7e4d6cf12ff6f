import numpy as np

from ss_flow.tasks.artifacts import Descriptors
from ss_flow.tasks.models.colour_words import ColourWords
from ss_flow.tasks.semantics import name as module
from ss_flow.tasks.semantics.name import name


def descriptor(instance_id: int, embedding, encoder: str) -> Descriptors:
    nothing = np.zeros(0, np.int32)
    return Descriptors(instance_id, np.asarray(embedding, np.float32), nothing, nothing.astype(np.float32), encoder)


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
