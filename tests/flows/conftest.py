"""One tiny capture and one run of it, for all the tests that only look."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from tiny_runs import Called, run_tiny, write_room


@dataclass(frozen=True)
class TinyRun:
    """A finished run."""

    scene: Path
    store: Path
    out: Path
    called: Called


@pytest.fixture(autouse=True)
def no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """No network of this machine, and no store of its user, has a part in these tests."""
    monkeypatch.setenv("SS_FLOW_MODELS", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home/.cache"))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("SS_FLOW_CACHE", raising=False)
    yield


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture; not to be changed."""
    return write_room(tmp_path_factory.mktemp("capture") / "room")


@pytest.fixture(scope="session")
def first_run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> TinyRun:
    """A run of it, of which tests get copies."""
    base = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SS_FLOW_MODELS", "")
        patch.setenv("HOME", str(base))
        called = run_tiny(room, base / "store", out=base / "out")
    assert called.code == 0, called.err
    return TinyRun(room, base / "store", base / "out", called)


def copied(run: TinyRun, folder: Path) -> TinyRun:
    """The run in another folder, with a store of its own."""
    store, out = folder / "store", folder / "out"
    shutil.copytree(run.store, store)
    shutil.copytree(run.out, out)
    record = out / "run.json"
    record.write_text(record.read_text().replace(str(run.store), str(store)))
    return replace(run, store=store, out=out)


@pytest.fixture(scope="module")
def tiny(first_run: TinyRun, tmp_path_factory: pytest.TempPathFactory) -> TinyRun:
    """A copy for a module to look at: exports and queries keep what they compute, which other modules would find."""
    return copied(first_run, tmp_path_factory.mktemp("module"))


@pytest.fixture
def warm(first_run: TinyRun, tmp_path: Path) -> TinyRun:
    """A copy for one test to go on from."""
    return copied(first_run, tmp_path)
