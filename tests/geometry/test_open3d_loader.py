from __future__ import annotations

import importlib
import subprocess
import sys

import pytest

from athlete_twin.errors import MissingLibraryError
from athlete_twin.geometry import open3d_loader


def test_open3d_loads_once_and_casts_rays():
    o3d = open3d_loader.open3d()
    assert o3d is open3d_loader.open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.create_box(2.0, 2.0, 2.0))
    hit = scene.cast_rays(o3d.core.Tensor([[1.0, 1.0, 5.0, 0.0, 0.0, -1.0]], dtype=o3d.core.float32))
    assert float(hit["t_hit"][0].item()) == pytest.approx(3.0)


def test_importing_the_loader_does_not_import_open3d():
    code = "import sys, athlete_twin.geometry.open3d_loader; sys.exit('open3d' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("problem", "named"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "apt-get install libgl1"),
        ("libusb-1.0.so.0: cannot open shared object file", "apt-get install libusb-1.0-0"),
        ("libodd-2.so.7: cannot open shared object file", "apt-file search libodd-2.so.7"),
        ("No module named 'open3d'", "pip install open3d-cpu"),
    ],
)
def test_a_missing_library_is_named_with_its_package(problem, named, monkeypatch):
    def fail(_: str) -> None:
        raise OSError(problem)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(MissingLibraryError, match=named):
        open3d_loader.open3d.__wrapped__()
