from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from ss_flow import distributions


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Put the metadata of a distribution that holds modules first on the path."""
    places: list[str] = []

    def install(name: str, version: str, *modules: str, declared: bool = False) -> Path:
        folder = tmp_path / str(len(places)) / f"{name.replace('-', '_')}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n\nVersion: none\n")
        (folder / "RECORD").write_text("".join(f"{module}/__init__.py,sha256=x,1\n" for module in modules))
        if declared:
            (folder / "RECORD").unlink()
            (folder / "top_level.txt").write_text("\n".join(modules))
        places.append(str(folder.parent))
        monkeypatch.syspath_prepend(folder.parent)
        forget()
        return folder

    def forget():
        distributions._distributions.cache_clear()
        distributions.is_distributed.cache_clear()

    yield install
    forget()


def test_python_s_own_library_says_the_same_of_every_installed_module():
    for module, names in importlib.metadata.packages_distributions().items():
        if module.isidentifier():
            assert distributions.versions_of(module) == {name: importlib.metadata.version(name) for name in names}


def test_of_distributions_that_hold_the_same_module_all_are_told(installed):
    installed("pictures-headless", "1.0", "pix")
    installed("pictures", "2.0", "pix", "more", declared=True)
    assert distributions.versions_of("pix") == {"pictures": "2.0", "pictures-headless": "1.0"}
    assert distributions.versions_of("more") == {"pictures": "2.0"}


def test_of_a_distribution_that_is_installed_twice_the_one_that_is_imported_counts(installed):
    installed("pictures", "1.0", "pix")
    installed("pictures", "2.0", "pix")
    assert distributions.versions_of("pix") == {"pictures": "2.0"} == {"pictures": distributions.version("pictures")}


def test_a_module_of_no_distribution_is_absent_under_its_own_name():
    assert distributions.versions_of("no_such_module") == {"no_such_module": "absent"}
    assert distributions.version("no-such-distribution") == "absent"


def test_the_version_of_an_editable_installation_tells_of_no_edit(installed):
    folder = installed("pictures", "1.0", "pix")
    installed("frames", "1.0", "frame")
    (folder / "direct_url.json").write_text('{"dir_info": {"editable": true}, "url": "file:///src"}')
    assert not distributions.is_distributed("pix") and distributions.is_distributed("frame")
