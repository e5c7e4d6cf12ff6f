"""Modules as they are written, read while other threads load more."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace

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
