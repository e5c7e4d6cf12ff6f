from pathlib import Path

import pytest

from ss_flow.errors import InputError
from ss_flow.task import FileRef
from ss_flow.tasks.models.catalogue import Model, ModelFile
from ss_flow.tasks.semantics.encoders import encoder_of


def test_without_a_model_the_colour_words_answer():
    assert encoder_of(None).name == "colour words"


def test_a_models_files_are_opened_as_clip(tmp_path: Path):
    (tmp_path / "vision.onnx").write_bytes(b"")
    file = FileRef(tmp_path / "vision.onnx", "00")
    files = tuple(ModelFile(role, file) for role in ("vision", "text", "vocabulary", "merges"))
    with pytest.raises(InputError, match=r"vision\.onnx cannot be read"):
        encoder_of(Model("clip", "text-image", files, (), ()))
