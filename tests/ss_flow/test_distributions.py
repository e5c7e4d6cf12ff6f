from __future__ import annotations

import importlib.metadata
import sys
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
        for remembered in (distributions._distributions, distributions._read, distributions._folders):
            remembered.cache_clear()
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


def written(folder: Path, module: str) -> Path:
    file = folder / module / "__init__.py"
    file.parent.mkdir(parents=True)
    file.touch()
    return file.parent


def test_the_version_of_another_module_of_the_same_name_tells_of_no_edit(installed, tmp_path, monkeypatch):
    written(installed("frames", "1.0", "frame").parent, "frame")
    assert distributions.is_distributed("frame")
    written(tmp_path / "mine", "frame")  # found before the one that is installed
    monkeypatch.syspath_prepend(tmp_path / "mine")
    distributions.is_distributed.cache_clear()
    assert not distributions.is_distributed("frame")


@pytest.mark.parametrize(("folder", "is_installed"), [("src", False), ("site-packages", True), ("dist-packages", True)])
def test_the_version_of_sources_that_were_once_built_in_their_folder_tells_of_no_edit(
    installed, tmp_path, monkeypatch, folder, is_installed
):
    written(tmp_path / folder, "frame")
    egg = tmp_path / folder / "frames.egg-info"
    egg.mkdir()
    (egg / "PKG-INFO").write_text("Metadata-Version: 2.1\nName: frames\nVersion: 1.0\n")
    (egg / "top_level.txt").write_text("frame\n")
    monkeypatch.syspath_prepend(tmp_path / folder)
    assert distributions.versions_of("frame") == {"frames": "1.0"}
    assert distributions.is_distributed("frame") == is_installed


def test_a_module_named_as_one_of_python_is_not_taken_for_it(installed, tmp_path, monkeypatch):
    assert all(map(distributions.is_distributed, ("math", "os", "tabnanny", "sys", "_socket", "xml")))
    written(tmp_path / "mine", "tabnanny")
    monkeypatch.syspath_prepend(tmp_path / "mine")
    monkeypatch.delitem(sys.modules, "tabnanny", raising=False)
    distributions.is_distributed.cache_clear()
    assert not distributions.is_distributed("tabnanny") and distributions.is_distributed("os")
