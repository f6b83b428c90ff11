"""`sparklod build-lod --refine`: options, names, reports, and what an interruption leaves."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.io.reading import read_scene
from tests.commands.build_lod.runs import ONE, build
from tests.conftest import FIXTURES, ROOT, Capture
from tests.fittings import STEPS, StandIn
from tests.fittings import stand_in as stand_in
from tests.signals import heed_signals

pytestmark = pytest.mark.slow

CAMERAS = "x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n0,1,-3,0,0,0\n"


@pytest.fixture
def cameras(tmp_path: Path) -> Path:
    path = tmp_path / "cameras.csv"
    path.write_text(CAMERAS)
    return path


@pytest.mark.parametrize(
    ("options", "steps", "seed"),
    [
        (("--refine",), None, 0),
        (("--refine", 300), 300, 0),
        (("--refine=300", "--seed", 4), 300, 4),
        (("--refine", "--method", "quality"), None, 0),
    ],
)
def test_steps_and_seed_are_those_that_were_asked_for(
    options: tuple[object, ...], steps: int | None, seed: int, scene: Path, cameras: Path, stand_in: StandIn
) -> None:
    assert build(scene, *options, "--camera-path", cameras) == 0
    ((settings, _),) = stand_in.calls
    assert (settings.steps, settings.seed) == (steps, seed)
    assert settings.path is not None
    assert len(settings.path) == 2


def test_without_it_nothing_is_fitted(scene: Path, stand_in: StandIn, capsys: Capture) -> None:
    assert build(scene, "--json") == 0
    assert not stand_in.calls
    assert json.loads(capsys.readouterr().out)["refine"] is None


def test_json_has_what_it_brought(scene: Path, stand_in: StandIn, capsys: Capture) -> None:
    assert build(scene, "--refine", "--seed", 2, "--json", "-q") == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    refined = record["refine"]
    keys = ("steps", "seed", "stages", "psnr_before", "psnr_after", "kept", "is_complete", "seconds")
    assert {*refined} == {*keys}
    assert (refined["steps"], refined["seed"], refined["kept"], refined["is_complete"]) == (STEPS, 2, 0.8, True)
    assert refined["psnr_before"]["0.02"] < refined["psnr_after"]["0.02"]
    assert refined["stages"][0]["name"] == "colours"
    assert record["seconds"]["refine"] >= 0
    assert err == ""


def test_the_report_has_a_line_for_each_stage_and_one_for_all(scene: Path, stand_in: StandIn, capsys: Capture) -> None:
    assert build(scene, "--refine", "-v") == 0
    err = capsys.readouterr().err
    assert "fit 1 of 1: 2 % 30.0 -> 32.5 dB\n" in err
    assert f"  refined in {STEPS} steps: held-out PSNR 2 % 30.00 -> 32.50, 5 % 30.00 -> 32.50," in err
    assert "50 % 30.00 -> 32.50 dB; 80 % of the splats fitted have new values\n" in err
    assert "quick tree, refined -> SPZ" in err


def test_a_scene_of_which_nothing_is_seen_is_said(tmp_path: Path, capsys: Capture) -> None:
    assert build(ONE, "--refine", "-o", tmp_path / "out.spz") == 0
    said = "refined in 0 steps: no held-out camera sees anything of it; 0 % of the splats fitted have new values\n"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ((), "scene-lod-refined.spz"),
        (("--format", "spz"), "scene-lod-refined.spz"),
        (("--format", "rad"), "scene-lod.rad"),
        (("-o", "other.spz"), "other.spz"),
    ],
)
def test_the_output_of_a_tree_has_a_name_of_its_own(
    given: tuple[str, ...], name: str, scene: Path, stand_in: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene.parent)
    assert build(scene) == 0
    before = (scene.parent / "scene-lod.spz").read_bytes()
    assert build("scene-lod.spz", "--refine", *given) == 0
    assert (scene.parent / name).stat().st_size
    assert (scene.parent / "scene-lod.spz").read_bytes() == before


def test_a_rad_stays_a_rad(scene: Path, stand_in: StandIn, capsys: Capture) -> None:
    assert build(scene, "--format", "rad") == 0
    tree = scene.with_name("scene-lod.rad")
    assert build(tree, "--refine") == 0
    assert read_scene(scene.with_name("scene-lod-refined.rad")).format == "RAD LoD"
    assert build(ONE, tree, "--refine", "--output-dir", scene.parent) == 2
    assert "--refine keeps the format of a Level-of-Detail file" in capsys.readouterr().err
    assert build(tree, "--refine", "-o", scene.with_name("other.spz")) == 0
    assert build(tree, "--refine", "--format", "rad-chunked", "-o", scene.with_name("other.rad")) == 0
    assert scene.with_name("other-0.radc").exists()


def test_a_tree_is_replaced_only_with_overwrite(scene: Path, stand_in: StandIn, capsys: Capture) -> None:
    assert build(scene) == 0
    tree = scene.with_name("scene-lod.spz")
    before = read_scene(tree)
    assert build(tree, "--refine", "-o", tree) == 2
    assert build(tree, "--refine", "-o", tree, "--overwrite", "--skip-existing") == 2
    assert "is an input" in capsys.readouterr().err
    assert build(tree, "--refine", "-o", tree, "--overwrite") == 0
    after = read_scene(tree)
    assert before.tree is not None
    leaf = before.tree.is_leaf
    assert np.array_equal(after.splats.center[leaf], before.splats.center[leaf])
    assert not np.array_equal(after.splats.center[~leaf], before.splats.center[~leaf])
    other = tree.with_name("other.spz")
    other.write_bytes(tree.read_bytes())
    assert build(tree, "--refine", "--camera-path", other, "-o", other, "--overwrite") == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--seed", 1), "--seed can only be used with --refine"),
        (("--camera-path", "c.csv"), "--camera-path can only be used with --refine"),
        (("--refine", "--resume"), "--resume cannot be used with --refine, which needs the whole tree in memory"),
        (("--refine", "--scratch-dir", "d"), "--scratch-dir cannot be used with --refine, which needs"),
        (("--refine", 0), "0 is not in the range"),
        (("--refine", "many"), "'many' is no number; put --refine after the inputs, or write --refine=2000"),
        (("--refine", "--seed", -1), "-1 is not in the range"),
    ],
)
def test_what_contradicts_it_is_wrong_usage(
    options: tuple[object, ...], said: str, scene: Path, stand_in: StandIn, capsys: Capture
) -> None:
    assert build(scene, *options) == 2
    assert said in capsys.readouterr().err
    assert not stand_in.calls


def test_an_input_after_it_is_not_taken_for_a_number(scene: Path, capsys: Capture) -> None:
    assert build("--refine", scene) == 2
    assert "is no number; put --refine after the inputs, or write --refine=2000" in capsys.readouterr().err


def test_cameras_that_are_none_fail_before_any_work(
    scene: Path, cameras: Path, stand_in: StandIn, capsys: Capture
) -> None:
    cameras.write_text("nonsense\n")
    assert build(scene, "--refine", "--camera-path", cameras) == 1
    assert f"{cameras}: " in capsys.readouterr().err
    assert not stand_in.calls
    assert sorted(path.name for path in scene.parent.iterdir()) == ["cameras.csv", "scene.ply"]


#: A fitting that says "ready", waits until it is told to stop, says that it heard that, and stops or goes on.
WAITING = """
import sys, time
from sparklod_cli import cli
from sparklod_cli.fitting import fit
from tests.fittings import StandIn

class Waiting(StandIn):
    def __call__(self, nodes, tree, settings, *, interrupted, **how):
        print("ready", flush=True)
        while not interrupted():
            time.sleep(0.01)
        print("heard", flush=True)
        while not {heeds}:
            time.sleep(0.01)
        self.is_complete = False
        return super().__call__(nodes, tree, settings, **how)

fit.fit = Waiting(kept={kept})
sys.argv[1:] = {arguments}
cli.main()
"""


def interrupted(
    folder: Path, *signals: int, heeds: bool = True, kept: float = 0.8, more: tuple[str, ...] = ()
) -> tuple[int, str]:
    """The exit status and the messages of a bake that gets signals while it fits."""
    scene = FIXTURES / "sh2.ply"
    arguments = ["build-lod", str(scene), *more, "--refine", "--output-dir", str(folder)]
    code = WAITING.format(heeds=heeds, kept=kept, arguments=arguments)
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_signals,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    for number in signals[:-1]:
        process.send_signal(number)
        assert process.stdout.readline() == "heard\n"
    process.send_signal(signals[-1])
    _, err = process.communicate(timeout=60)
    return process.returncode, err.lstrip()


def test_ctrl_c_keeps_what_was_gained(tmp_path: Path) -> None:
    code, err = interrupted(tmp_path, signal.SIGINT, more=(str(FIXTURES / "one.ply"),))
    assert code == 130
    assert err.endswith("interrupted\n")
    assert "writing the improvements of the finished stages" in err
    assert f"refined in {STEPS} steps, interrupted: held-out PSNR" in err
    assert [path.name for path in tmp_path.iterdir()] == ["sh2-lod.spz"]  # and the other input is not begun
    assert read_scene(tmp_path / "sh2-lod.spz").tree is not None


def test_ctrl_c_before_anything_was_gained_leaves_nothing(tmp_path: Path) -> None:
    code, err = interrupted(tmp_path, signal.SIGINT, kept=0)
    assert code == 130
    assert err.endswith("\ninterrupted\n")
    assert "Stopped before --refine improved anything; no file written." in err
    assert not list(tmp_path.iterdir())


def test_a_second_ctrl_c_ends_at_once(tmp_path: Path) -> None:
    code, err = interrupted(tmp_path, signal.SIGINT, signal.SIGINT, heeds=False)
    assert (code, err) == (130, "interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP])
def test_other_signals_end_as_ever(how: signal.Signals, tmp_path: Path) -> None:
    code, err = interrupted(tmp_path, how)
    assert (code, err) == (130, "interrupted\n")
    assert not list(tmp_path.iterdir())
