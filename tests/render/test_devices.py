"""Devices are chosen, and what is wrong with a card is one line; on machines without one."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import sparklod_cli as sparklod
from sparklod_cli.cli import run
from sparklod_cli.fitting.settings import FitSettings
from sparklod_cli.render.cuda.card import card_errors, on_card
from sparklod_cli.render.settings import DEVICES, uses_card
from sparklod_cli.system.errors import BackendError
from tests.cards import MISSING
from tests.conftest import FIXTURES, Capture

pytestmark = pytest.mark.skipif(not MISSING, reason="there is a card")

#: Draws by the processor, and prints the modules that only a card needs.
DRAW = """
import sys
from sparklod_cli.cli import run
assert run(["render", sys.argv[1], "--size", "16x16", "-o", sys.argv[2], "-q"]) == 0
print([name for name in sys.modules if "jit_cuda" in name or "render.cuda" in name or name == "cupy"])
"""


def test_the_processor_is_used_unless_a_card_is_asked_for() -> None:
    assert not uses_card("cpu")
    assert FitSettings().device == "cpu"
    with pytest.raises(ValueError, match="device"):
        FitSettings(device="gpu")


def test_auto_is_the_processor_without_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert not uses_card("auto", said.append)
    assert not said  # the extra is not installed
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert not uses_card("auto", said.append)
    assert len(said) == 1
    assert said[0].startswith("uses the processor: ")


def test_a_card_that_is_not_there_is_one_line() -> None:
    with pytest.raises(BackendError) as error:
        uses_card("cuda")
    assert "\n" not in str(error.value)


def test_what_the_extra_brings_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    monkeypatch.delattr(numba, "cuda", raising=False)
    monkeypatch.setitem(sys.modules, "numba.cuda", None)
    with pytest.raises(BackendError, match=r"needs numba-cuda: .*install"):
        uses_card("cuda")


class Context:
    """Memory of a card of 10 GB, of which 4 are free."""

    def get_memory_info(self) -> tuple[int, int]:
        return 4 * 10**9, 10 * 10**9


def test_too_little_memory_is_one_line_with_the_splats_that_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    from numba import cuda

    def device_array(*arguments: object) -> None:
        raise RuntimeError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")

    monkeypatch.setattr(cuda, "device_array", device_array)
    monkeypatch.setattr(cuda, "current_context", Context)
    for size, fits in ((4.1e9, "990,000"), (14e9, "500,000")):
        with pytest.raises(BackendError) as error, card_errors(1_000_000):
            on_card(int(size / 4))
        assert str(error.value).startswith(f"the card has too little memory for 1,000,000 splats; about {fits} fit, or")
    with pytest.raises(BackendError, match="; fewer fit"), card_errors(5):
        raise type("OutOfMemoryError", (Exception,), {})  # of cupy


@pytest.mark.parametrize("device", DEVICES)
def test_commands_take_a_device(device: str, tmp_path: Path, capsys: Capture) -> None:
    output, file = tmp_path / "out.png", str(FIXTURES / "sh1.ply")
    status = run(["render", file, "--size", "16x16", "--device", device, "-o", str(output), "-q"])
    assert status == (device == "cuda")
    assert output.exists() == (device != "cuda")
    assert len(capsys.readouterr().err.splitlines()) == (device == "cuda")


@pytest.mark.parametrize("backend", ["osmesa", "open3d"])
def test_only_the_reference_takes_a_device(backend: str, tmp_path: Path, capsys: Capture) -> None:
    output, file = tmp_path / "out.png", FIXTURES / "sh1.ply"
    assert run(["render", str(file), "--backend", backend, "--device", "cuda", "-o", str(output)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"error: --device cannot be used with --backend {backend}"
    camera = sparklod.Camera.look_at([0, 0, -3], [0, 0, 0], fov_y=50, size=(8, 8))
    settings = sparklod.RenderSettings(backend=backend, device="cuda")
    with pytest.raises(ValueError, match=f"on cards, not {backend}"):
        sparklod.render(sparklod.read(file), camera, settings=settings)


def test_nothing_of_a_card_is_imported_without_one(tmp_path: Path) -> None:
    arguments = [sys.executable, "-c", DRAW, str(FIXTURES / "sh1.ply"), str(tmp_path / "out.png")]
    found = subprocess.run(arguments, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
