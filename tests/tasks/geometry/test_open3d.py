import subprocess
import sys

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
