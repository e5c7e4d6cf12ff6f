"""Modules as they are written, read while other threads load more."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import pytest

from ss_flow import sources


class LoadsAnother(str):
    """The name of a module; while it is looked at, another thread loads one more."""

    def startswith(self, *args) -> bool:
        sources.sys.modules["another"] = ModuleType("another")
        return super().startswith(*args)


def test_loaded_modules_can_be_looked_through_while_others_are_loaded(monkeypatch):
    modules = {LoadsAnother("probe.a"): ModuleType("probe.a"), "other": ModuleType("other")}
    monkeypatch.setattr(sources, "sys", SimpleNamespace(modules=modules))
    assert sources._loaded.__wrapped__(("probe",), False, 2) == ["probe.a"]


def test_a_program_that_is_run_as_a_module_is_not_read(monkeypatch):
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", importlib.util.find_spec("pytest.__main__"))
    assert not sources.read_loaded(("__main__",), False)
    assert sources.source_of("__main__") is None


@pytest.mark.parametrize("changed", ["probe.a", "probe.b"])
def test_of_several_modules_that_are_loaded_anew_each_one_that_changed_is_told(monkeypatch, changed):
    text = {"probe.a": "1", "probe.b": "1"}
    monkeypatch.setattr(sources, "_known", {})
    monkeypatch.setattr(sources, "_loaded", lambda *_: list(text))
    monkeypatch.setattr(sources, "_specification", lambda name: object())  # another one each time
    monkeypatch.setattr(sources, "_read", text.__getitem__)
    monkeypatch.setattr(sources, "not_as_written", lambda name: "")
    assert not sources.read_loaded(("probe",), False) and not sources.read_loaded(("probe",), False)
    text[changed] = "2"
    assert sources.read_loaded(("probe",), False) and not sources.read_loaded(("probe",), False)
