import subprocess
import sys

import pytest

from ss_flow.errors import InputError
from ss_flow.tasks.geometry import open3d

SCRIPT = """
import sys
from ss_flow.tasks.geometry.open3d import load_open3d
visualization = load_open3d().visualization
assert not {"dash", "plotly"} & set(sys.modules)
cloud = load_open3d().geometry.PointCloud(load_open3d().utility.Vector3dVector([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
print(type(visualization.get_plotly_fig([cloud])).__name__)
"""


def test_what_draws_in_notebooks_is_loaded_when_it_draws():
    run = subprocess.run([sys.executable, "-P", "-c", SCRIPT], capture_output=True, text=True)
    assert run.stdout.split() == ["Figure"], run.stderr


def test_where_it_is_not_installed_no_system_library_is_blamed(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"^open3d cannot be loaded .*: install ss-flow again\.$"):
        open3d.load_open3d.__wrapped__()


def test_a_missing_system_library_is_to_be_installed(monkeypatch):
    def load(name):
        raise OSError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(open3d.importlib, "import_module", load)
    with pytest.raises(InputError, match=r"libGL\.so\.1.*`apt-get install"):
        open3d.load_open3d.__wrapped__()
