"""Bakes out of core that are killed, interrupted or run out of disk: what is done is kept, and --resume ends with the
same bytes."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from sparklod_cli.bake import planning
from sparklod_cli.bake.flow import SCRATCH as SUFFIX
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.job import PUBLISHED
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.bake.skipping import bake_unless_there
from sparklod_cli.bake.store import Store
from sparklod_cli.system.errors import InvalidSplatsError, OutputError, ScratchError
from tests.faults.test_faults import DEMO, ENVIRONMENT, mounted
from tests.signals import heed_signals

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="there is no kill -9 on Windows")]

#: Small enough for the demo to be several blocks.
BLOCK_SPLATS = 5000

#: Bakes out of core; kills itself halfway through the result of this number, or waits there for a signal.
SCRIPT = """
import os, signal, sys, time
from pathlib import Path
from sparklod_cli.bake.flow import bake
from sparklod_cli.bake.settings import BakeSettings, Resources
from sparklod_cli.bake import store
from sparklod_cli.system import interrupts

source, target, scratch, method, suffix, moment, how = sys.argv[1:]
left, encode = int(moment), store.encode

def halfway(pieces):
    for number, piece in enumerate(pieces):
        if number == 2:
            if how == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            print("waits", flush=True)
            time.sleep(60)
        yield piece

def failing(arrays):
    global left
    left -= 1
    return halfway(encode(arrays)) if left == 0 else encode(arrays)

store.encode = failing
interrupts.handle()
try:
    bake(Path(source), Path(target), BakeSettings(method=method, suffix=suffix), say=print,
         resources=Resources(scratch_dir=Path(scratch), block_splats=int(os.environ["BLOCK_SPLATS"])))
except KeyboardInterrupt:
    sys.exit(130)
"""


def begun(target: Path, scratch: Path, method: str, moment: int, how: str) -> subprocess.Popen[str]:
    """A process that bakes the demo, and ends at some moment."""
    words = [DEMO, target, scratch, method, target.suffix, moment, how]
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *map(str, words)],
        env={**ENVIRONMENT, "BLOCK_SPLATS": str(BLOCK_SPLATS)},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=heed_signals,
    )


def baked(target: Path, scratch: Path, method: str = "quick", **how: bool) -> list[str]:
    """Bakes the demo in this process; what was said."""
    said: list[str] = []
    resources = Resources(scratch_dir=scratch, block_splats=BLOCK_SPLATS, resume=how.pop("resume", False))
    bake(DEMO, target, BakeSettings(method=method, suffix=target.suffix), resources=resources, say=said.append, **how)
    return said


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], bytes]:
    """The outputs of bakes that nothing interrupts, by method and suffix."""
    folder, found = tmp_path_factory.mktemp("whole"), {}
    for method, suffix in (("quick", ".rad"), ("quality", ".spz")):
        target = folder / f"{method}{suffix}"
        baked(target, folder / "scratch", method)
        assert not (folder / "scratch").exists()
        found[method, suffix] = target.read_bytes()
    return found


#: While parts of the input are read, while blocks are built, and while they are joined.
@pytest.mark.parametrize(
    ("method", "suffix", "moment"),
    [("quick", ".rad", 9), ("quality", ".spz", 15), ("quick", ".rad", 23)],
)
def test_a_killed_bake_goes_on_and_ends_with_the_same_bytes(
    method: str, suffix: str, moment: int, tmp_path: Path, whole: dict[tuple[str, str], bytes]
) -> None:
    target, scratch = tmp_path / f"out{suffix}", tmp_path / "scratch"
    process = begun(target, scratch, method, moment, "kill")
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert not target.exists()
    (folder,) = scratch.iterdir()
    assert folder.name.endswith(SUFFIX)
    said = baked(target, scratch, method, resume=True)
    assert any("continues with" in line for line in said)
    assert target.read_bytes() == whole[method, suffix]
    assert list(scratch.iterdir()) == []


def test_an_interrupted_bake_says_what_is_left_and_is_refused_or_begun_anew(
    tmp_path: Path, whole: dict[tuple[str, str], bytes]
) -> None:
    target, scratch = tmp_path / "out.rad", tmp_path / "scratch"
    process = begun(target, scratch, "quick", 20, "wait")
    assert process.stdout is not None
    while process.stdout.readline() != "waits\n":
        assert process.poll() is None
    with pytest.raises(ScratchError, match="another run is at work"):
        baked(target, scratch)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate()
    assert process.returncode == 130
    (folder,) = scratch.iterdir()
    assert f"finished work stays in {folder}; run the command again with --resume" in out
    with pytest.raises(ScratchError, match="an interrupted bake left"):
        baked(target, scratch)
    with pytest.raises(ScratchError, match=r"results of another bake: .*method was 'quick' and is 'quality'"):
        baked(target, scratch, "quality", resume=True)
    for path in (folder / "families").glob("*.npy"):  # as if power had failed
        os.truncate(path, path.stat().st_size - 7)
    assert "that a failure damaged" in "".join(baked(target, scratch, resume=True))
    assert target.read_bytes() == whole["quick", ".rad"]
    assert list(scratch.iterdir()) == []


def stop_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupts bakes when their output is in place, and nothing of their scratch is removed."""
    clear = planning._clear

    def interrupted(store: Store) -> None:
        if store.has(PUBLISHED):
            raise KeyboardInterrupt
        clear(store)

    monkeypatch.setattr(planning, "_clear", interrupted)


@pytest.mark.parametrize("bakes", [bake, bake_unless_there], ids=lambda bakes: bakes.__name__)
def test_a_bake_whose_output_is_in_place_is_resumed(
    bakes: Callable[..., object], tmp_path: Path, whole: dict[tuple[str, str], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    target, settings = tmp_path / "out.rad", BakeSettings(suffix=".rad")
    resources = Resources(block_splats=BLOCK_SPLATS, resume=True)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        stop_at_the_end(patch)
        bakes(DEMO, target, settings, resources=resources)
    assert target.read_bytes() == whole["quick", ".rad"]
    with pytest.raises(OutputError, match="--overwrite"):
        bakes(DEMO, target, settings, resources=dataclasses.replace(resources, resume=False))
    bakes(DEMO, target, settings, resources=resources)
    assert target.read_bytes() == whole["quick", ".rad"]
    assert not (tmp_path / f"out.rad{SUFFIX}").exists()


def test_leftover_results_are_refused_or_removed_and_no_file_of_others_is_replaced(tmp_path: Path) -> None:
    target = tmp_path / "out.rad"
    begun(target, tmp_path, "quick", 23, "kill").communicate()
    settings, resources = BakeSettings(suffix=".rad"), Resources(scratch_dir=tmp_path)
    with pytest.raises(ScratchError, match="an interrupted bake left"):
        bake(DEMO, target, settings, resources=resources)  # in memory
    target.write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"out\.rad exists, add --overwrite"):
        baked(target, tmp_path, resume=True)
    assert target.read_bytes() == b"mine"
    assert bake(DEMO, target, settings, resources=resources, overwrite=True).blocks is None
    assert [path.name for path in tmp_path.iterdir()] == ["out.rad"]


def test_a_full_scratch_disk_is_one_error_and_room_lets_it_go_on(
    tmp_path: Path, whole: dict[tuple[str, str], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparklod_cli.bake import estimate

    target = tmp_path / "out.rad"
    with mounted(tmp_path / "disk", "size=4m") as disk:
        with pytest.raises(ScratchError, match=r"will take about .* MB are free there; .*--scratch-dir"):
            baked(target, disk)
        assert list(disk.iterdir()) == []
        monkeypatch.setattr(estimate, "scratch_bytes", lambda *_: 0)
        with pytest.raises(ScratchError, match=r"no room left in the scratch folder .*: no space left .*--resume"):
            baked(target, disk)
        assert not target.exists()
        subprocess.run(["mount", "-o", "remount,size=64m", disk], check=True)
        baked(target, disk, resume=True)
        assert target.read_bytes() == whole["quick", ".rad"]
        assert list(disk.iterdir()) == []


def test_an_input_that_cannot_be_baked_leaves_no_folder(tmp_path: Path) -> None:
    source = tmp_path / "cut.ply"
    data = bytearray(DEMO.read_bytes())
    data[-100_000:] = b"\xff" * 100_000  # not finite
    source.write_bytes(data)
    for scratch in (tmp_path / "scratch", None):
        resources = Resources(scratch_dir=scratch, block_splats=BLOCK_SPLATS)
        with pytest.raises(InvalidSplatsError, match="--on-invalid drop"):
            bake(source, tmp_path / "new" / "out.spz", BakeSettings(), resources=resources)
    assert [path.name for path in tmp_path.iterdir()] == ["cut.ply"]
