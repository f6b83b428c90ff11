"""Where the OpenGL of the backend osmesa comes from: either library, or a word on what is missing; never a crash."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.figures.pyvista_scene import load_pyvista
from sparklod_cli.render.gl import context, osmesa
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.system.errors import BackendError, SparklodError
from sparklod_cli.system.packages import install_hint
from tests.render.gl.test_osmesa import CAMERAS, SPLATS, needs_opengl, opengl

pytestmark = pytest.mark.slow

__all__ = ["opengl"]  # a fixture


def child(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(filter(None, sys.path))
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": path, **environment},
    )


DRAW_ONE = """
import numpy as np
from sparklod_cli.system.errors import SparklodError
from sparklod_cli.render.gl import osmesa
from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.render.rasterizer import ShadedSplats
rows = [[0, 0, -5]], [[0.1] * 3], [[0, 0, 0, 1]], [0.5], [[1, 1, 1]]
shown = ShadedSplats(*(np.array(row, np.float32) for row in rows))
try:
    print(osmesa.draw(shown, Camera(np.eye(4), 8, 8, (1e3, 1e3), (4.5, 4.5)), RasterSettings())[4, 4, 3])
except SparklodError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize("kind", context.PACKAGES)
def test_either_opengl_library_is_enough(kind: str) -> None:
    if reason := context.probe(kind):
        pytest.skip(f"no OpenGL by {kind} (on Debian and Ubuntu: apt install {context.PACKAGES[kind]}): {reason}")
    only = f"from sparklod_cli.render.gl import context\ncontext.PACKAGES = {{{kind!r}: ''}}\n"
    done = child(only + DRAW_ONE)
    assert float(done.stdout) == pytest.approx(0.5 * 400 / 400.3, abs=1e-5), done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="libraries are hidden as Linux finds them")
def test_missing_libraries_are_named(tmp_path: Path) -> None:
    pytest.importorskip("moderngl")
    for name in (*context.OSMESA_NAMES, "libEGL.so", "libEGL.so.1"):
        (tmp_path / name).write_bytes(b"")
    done = child(DRAW_ONE, LD_LIBRARY_PATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("BackendError the backend osmesa finds no OpenGL")
    assert "apt install libosmesa6 or libegl1" in done.stdout and done.stdout.count("\n") == 1


def test_the_extra_that_brings_moderngl_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(BackendError, match=re.escape(install_hint("render", package="moderngl"))):
        osmesa.open_context.__wrapped__()


@pytest.mark.skipif(sys.platform == "win32", reason="no signals")
def test_a_driver_that_crashes_is_no_crash_here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nkill -SEGV $$\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    assert context.probe.__wrapped__("osmesa") == "the driver ended the test process by signal 11"


def test_a_forked_process_gets_no_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    osmesa.on_gl_thread(lambda: None)
    monkeypatch.setattr("os.getpid", lambda: -1)
    with pytest.raises(BackendError, match="spawn"):
        osmesa.on_gl_thread(lambda: None)


@needs_opengl
def test_other_opengl_contexts_are_left_alone() -> None:
    """VTK takes it for granted that nobody else makes a context current on its thread."""
    pytest.importorskip("pyvista")
    try:
        pyvista = load_pyvista()
    except SparklodError as error:
        pytest.skip(str(error))
    plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64))
    plotter.add_mesh(pyvista.Sphere())
    before, image = (
        plotter.screenshot(None, return_img=True),
        osmesa.draw(SPLATS["plausible"], CAMERAS["front"], RasterSettings()),
    )
    plotter.render()
    assert np.array_equal(plotter.screenshot(None, return_img=True), before)
    plotter.close()
    assert np.array_equal(osmesa.draw(SPLATS["plausible"], CAMERAS["front"], RasterSettings()), image)
