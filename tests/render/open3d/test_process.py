"""The process in which Open3D draws: one for all pictures, and an error where it fails."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from sparklod_cli.cameras.camera import Camera
from sparklod_cli.render.open3d import backend
from sparklod_cli.render.rasterizer import ShadedSplats
from sparklod_cli.render.settings import RasterSettings
from sparklod_cli.system.errors import BackendError
from tests.conftest import ROOT

pytestmark = pytest.mark.slow


def forget() -> None:
    if backend._child is not None:
        backend._child.close()
        backend._child = None


PREAMBLE = """
import os, sys, time
import numpy as np
from sparklod_cli.render.open3d.child import send, receive
inn, out = sys.stdin.buffer, sys.stdout.buffer
"""


@pytest.fixture
def play(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Puts another program in the place of Open3D's."""

    def put(text: str) -> None:
        monkeypatch.setattr(backend, "command", lambda: [sys.executable, "-c", PREAMBLE + textwrap.dedent(text)])

    forget()
    yield put
    forget()


def draw_one(width: int = 60) -> NDArray[np.float32]:
    """A splat in the middle."""
    rows = np.array([[0, 0, -1]]), np.array([[0.1, 0.1, 0.1]]), np.array([[0, 0, 0, 1]]), np.ones(1), np.ones((1, 3))
    camera = Camera(np.eye(4), width, 40, (200.0, 200.0), (width / 2, 20.0))
    return backend.draw(ShadedSplats(*(column.astype(np.float32) for column in rows)), camera, RasterSettings())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("print('no libvulkan', file=sys.stderr, flush=True); os._exit(3)", "crashed: no libvulkan .*mesa-vulkan-dri"),
        ("os.abort()", "crashed: exit code -6"),
        ("send(out, {'error': 'there is no Vulkan'})", "^there is no Vulkan$"),
        ("send(out, {}); receive(inn); print('ouch', file=sys.stderr, flush=True); os.abort()", "crashed: ouch$"),
        ("send(out, {}); receive(inn); send(out, {'error': 'too many'})", "^too many$"),
        ('send(out, {}); receive(inn); out.write(b\'{"array": {"type"\'); out.flush()', "crashed"),
        ("send(out, {}); receive(inn); time.sleep(60)", "not answered for 1.5 seconds"),
    ],
)
def test_a_failing_process_is_an_error(
    play: Callable[[str], None], monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    play(text)
    if "not answered" in message:
        monkeypatch.setattr(backend, "DRAW_LIMIT", 1.5)
    with pytest.raises(BackendError, match=message):
        draw_one()
    with pytest.raises(BackendError, match=message):  # and again, by a new one
        draw_one()


def test_a_missing_package_is_named(play: Callable[[str], None]) -> None:
    play("sys.modules['open3d'] = None; from sparklod_cli.render.open3d.child import main; main()")
    with pytest.raises(BackendError, match=r"package open3d, which is not installed: .*pip install 'open3d>=0.20'"):
        draw_one()


def test_a_missing_library_is_named(play: Callable[[str], None]) -> None:
    text = """
    class Finder:
        def find_spec(self, name, *more):
            if name == "open3d":
                raise ImportError("libusb-1.0.so.0: cannot open shared object file")
    sys.meta_path.insert(0, Finder())
    from sparklod_cli.render.open3d.child import main
    main()
    """
    play(text)
    with pytest.raises(BackendError, match=r"libusb-1.0.so.0: .*apt install libegl1 .*libusb-1.0-0"):
        draw_one()


def test_an_open3d_that_knows_no_splats_is_too_old(play: Callable[[str], None]) -> None:
    text = """
    from types import SimpleNamespace as Space
    rendering = Space(MaterialRecord=lambda: Space())
    sys.modules["open3d"] = Space(__version__="0.19.0", visualization=Space(rendering=rendering))
    from sparklod_cli.render.open3d.child import main
    main()
    """
    play(text)
    with pytest.raises(BackendError, match=r"Open3D 0\.19\.0 cannot draw splats: .*pip install --upgrade"):
        draw_one()


#: Draws its process' number, as grey.
NUMBER = """
send(out, {})
while True:
    try:
        request, splats = receive(inn)
    except EOFError:
        break
    side = request["side"]
    send(out, {}, np.full((2, side, side, 3), os.getpid() % 251 + 1, np.uint8))
"""


def test_one_process_draws_all_pictures(play: Callable[[str], None]) -> None:
    play(NUMBER)
    first, second = draw_one(), draw_one(300)
    child = backend._child
    assert child is not None and child.most_entries == backend.MOST_ENTRIES
    grey = (child._process.pid % 251 + 1) / 255
    assert first.shape == (40, 60, 4) and second.shape == (40, 300, 4)
    np.testing.assert_allclose(first[..., :3], grey, rtol=1e-6)
    np.testing.assert_allclose(first[..., 3], 1)
    child._process.stdin.close()
    assert child._process.wait(60) == 0  # it ends by itself
    forget()


def test_an_old_mesa_gets_small_pieces(play: Callable[[str], None]) -> None:
    play("print('Vulkan device driver: llvmpipe Mesa 22.3.6', file=sys.stderr, flush=True)" + NUMBER)
    draw_one()
    child = backend._child
    assert child is not None and child.most_entries == backend.MOST_ENTRIES_OF_OLD_MESA


def test_the_process_ends_with_its_parent() -> None:
    program = f"""
    import sys
    from sparklod_cli.render.open3d import backend
    backend.command = lambda: [sys.executable, "-c", {PREAMBLE + NUMBER!r}]
    print(backend.Child()._process.pid, "open3d" in sys.modules)
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    said = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT, timeout=120).stdout.split()
    assert said[1] == "False"
    for _ in range(600):
        try:
            os.kill(int(said[0]), 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("it goes on")
