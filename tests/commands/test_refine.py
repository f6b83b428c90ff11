"""`--refine` of `build-lod` and `refine` of the API: settings, names, reports, and what an interruption leaves."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.splats import same_rows
from tests.commands.cli import NAMED, Cli
from tests.conftest import ROOT
from tests.fittings import STEPS, StandIn
from tests.fittings import stand_in as stand_in
from tests.signals import heed_signals

SMALL, CAMERAS = "sh2.ply", "x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n0,1,-3,0,0,0\n"


@pytest.mark.parametrize(
    ("options", "steps", "seed"),
    [
        ("--refine", None, 0),
        ("--refine 300", 300, 0),
        ("--refine=300 --seed 4", 300, 4),
        ("--refine --method quality", None, 0),
    ],
)
def test_steps_seed_and_cameras_reach_the_fitting(
    options: str, steps: int | None, seed: int, cli: Cli, stand_in: StandIn
) -> None:
    cli.put("cameras.csv", CAMERAS)
    cli(f"build-lod {SMALL} {options} --camera-path cameras.csv")
    ((settings, _),) = stand_in.calls
    assert (settings.steps, settings.seed) == (steps, seed)
    assert settings.path is not None and len(settings.path) == 2
    assert cli(f"build-lod {SMALL} --json -f").json["refine"] is None and len(stand_in.calls) == 1


def test_reports_have_the_gain_of_each_stage(cli: Cli, stand_in: StandIn) -> None:
    done = cli(f"build-lod {SMALL} --refine --seed 2 --json -q")
    refined = done.json["refine"]
    keys = "steps", "seed", "stages", "psnr_before", "psnr_after", "kept", "is_complete", "seconds"
    assert {*refined} == {*keys} and done.err == ""
    assert (refined["steps"], refined["seed"], refined["kept"], refined["is_complete"]) == (STEPS, 2, 0.8, True)
    assert refined["psnr_before"]["0.02"] < refined["psnr_after"]["0.02"]
    assert refined["stages"][0]["name"] == "colours" and done.json["seconds"]["refine"] >= 0
    err = cli(f"build-lod {SMALL} --refine -v -f").err
    assert "fit 1 of 1: 2 % 30.0 -> 32.5 dB\n" in err
    assert f"  refined in {STEPS} steps: held-out PSNR 2 % 30.00 -> 32.50, 5 % 30.00 -> 32.50," in err
    assert "50 % 30.00 -> 32.50 dB; 80 % of the splats fitted have new values\n" in err
    assert "quick tree, refined -> SPZ" in err


@pytest.mark.slow
def test_a_scene_that_no_camera_sees_is_reported(cli: Cli) -> None:
    said = "refined in 0 steps: no held-out camera sees anything of it; 0 % of the splats fitted have new values\n"
    assert said in cli("build-lod one.ply --refine -o a.spz").err


def test_the_output_of_a_tree_has_a_name_of_its_own(cli: Cli, stand_in: StandIn) -> None:
    cli(f"build-lod {SMALL}")
    cli(f"build-lod {SMALL} --format rad -o t-lod.rad")
    before = {name: Path(name).read_bytes() for name in ("sh2-lod.spz", "t-lod.rad")}
    for options, name in (
        *(("sh2-lod.spz", "sh2-lod-refined.spz"), ("sh2-lod.spz --format spz -f", "sh2-lod-refined.spz")),
        *(("sh2-lod.spz --format rad", "sh2-lod.rad"), ("sh2-lod.spz -o other.spz", "other.spz")),
        *(("t-lod.rad", "t-lod-refined.rad"), ("t-lod.rad -o t.spz", "t.spz")),
        ("t-lod.rad --format rad-chunked -o many.rad", "many-0.radc"),
    ):
        cli(f"build-lod {options} --refine")
        assert Path(name).stat().st_size
    assert before == {name: Path(name).read_bytes() for name in before}
    said = "--refine keeps the format of a Level-of-Detail file"
    assert said in cli("build-lod one.ply t-lod.rad --refine --output-dir ./", status=2).err


def test_a_tree_is_replaced_only_with_overwrite(cli: Cli, stand_in: StandIn) -> None:
    cli(f"build-lod {SMALL} -o a.spz")
    before = read_scene(Path("a.spz"))
    cli("build-lod a.spz --refine -o a.spz", status=2)
    assert "is an input" in cli("build-lod a.spz --refine -o a.spz -f --skip-existing", status=2).err
    cli.put("b.spz", Path("a.spz").read_bytes())
    cli("build-lod a.spz --refine -o b.spz --camera-path b.spz -f", status=2)
    cli("build-lod a.spz --refine -o a.spz -f")
    after = read_scene(Path("a.spz"))
    assert before.tree is not None
    leaf = before.tree.is_leaf
    assert np.array_equal(after.splats.center[leaf], before.splats.center[leaf])
    assert not np.array_equal(after.splats.center[~leaf], before.splats.center[~leaf])


# --- The API ----------------------------------------------------------------------------------------------------------


def test_a_tree_is_fitted_as_by_the_command(cli: Cli, stand_in: StandIn) -> None:
    cli(f"build-lod {SMALL} --method quality -o a.spz")
    held, said = sparklod.read("a.spz"), list[str]()
    assert isinstance(held, sparklod.Tree)
    fitted, report = sparklod.refine(held, seed=3, say=said.append, threads=2)
    assert isinstance(fitted, sparklod.Tree) and isinstance(report, sparklod.Refined)
    assert (report.steps, report.seed, report.is_complete) == (STEPS, 3, True)
    assert said == ["fit 1 of 1: 2 % 30.0 -> 32.5 dB"]
    cli("build-lod a.spz --refine --seed 3 -o theirs.spz -q")
    theirs = sparklod.read("theirs.spz")
    for ours in (theirs, fitted):
        assert ours.tree is not None and np.array_equal(ours.tree.child_start, held.tree.child_start)
        assert same_rows(ours.splats, held.splats)[held.tree.is_leaf].all()
    np.testing.assert_allclose(theirs.splats.center, fitted.splats.center, atol=2e-3)


def test_a_scene_is_built_and_fitted(cli: Cli, stand_in: StandIn) -> None:
    scene = sparklod.read(NAMED[SMALL])
    cli(f"build-lod {SMALL} --refine 7 -o theirs.spz -q")
    for refine in (7, sparklod.FitSettings(steps=7)):
        sparklod.write("ours.spz", sparklod.build_lod(scene, refine=refine), overwrite=True)
        assert Path("ours.spz").read_bytes() == Path("theirs.spz").read_bytes()
    assert [settings.steps for settings, _ in stand_in.calls] == [7, 7, 7]
    tree = sparklod.build_lod(scene, refine=True)
    assert stand_in.calls[-1][0] == sparklod.FitSettings()
    sparklod.build_lod(scene)
    assert len(stand_in.calls) == 4
    camera = sparklod.Camera.look_at((0.5, -1, 4), (0, 0, 0), size=(160, 120))
    for cameras in (camera, [camera], sparklod.orbit(tree, count=1)):
        sparklod.refine(tree, cameras=cameras)
        path = stand_in.calls[-1][0].path
        assert path is not None and len(path) == 1


def test_impossible_fittings_are_refused(stand_in: StandIn) -> None:
    scene = sparklod.read(NAMED[SMALL])
    tree = sparklod.build_lod(scene)
    with pytest.raises(sparklod.FormatError, match="no Level-of-Detail tree; build_lod makes one"):
        sparklod.refine(scene)
    for wrong in ({"steps": 0}, {"seed": -1}, {"cameras": []}):
        with pytest.raises(ValueError, match=r"give|there are no cameras"):
            sparklod.refine(tree, **wrong)  # type: ignore[arg-type]
    for wrong in ({"steps": 1.5}, {"cameras": "orbit"}):
        with pytest.raises(TypeError):
            sparklod.refine(tree, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="refine is 0; give 1 to"):
        sparklod.build_lod(scene, refine=0)
    with pytest.raises(TypeError, match="refine is 'yes'"):
        sparklod.build_lod(scene, refine="yes")  # type: ignore[arg-type]
    assert not stand_in.calls


# --- Interruptions ----------------------------------------------------------------------------------------------------

#: A fitting that prints "ready", waits until it is interrupted, prints "heard", and stops or goes on.
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


def interrupted(folder: Path, *signals: int, heeds: bool = True, kept: float = 0.8) -> str:
    """Return the messages of a bake of two scenes that gets signals while it fits the first."""
    arguments = ["build-lod", str(NAMED[SMALL]), str(NAMED["one.ply"]), "--refine", "--output-dir", str(folder)]
    code = WAITING.format(heeds=heeds, kept=kept, arguments=arguments)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, text=True, preexec_fn=heed_signals, **pipes)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for number in signals[:-1]:
        process.send_signal(number)
        assert process.stdout.readline() == "heard\n"
    process.send_signal(signals[-1])
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    return re.sub(r".* % done after .*\n", "", err).lstrip()


@pytest.mark.slow
def test_ctrl_c_keeps_the_gain_of_the_finished_stages(tmp_path: Path) -> None:
    err = interrupted(tmp_path, signal.SIGINT)
    assert err.endswith("interrupted\n") and "writing the improvements of the finished stages" in err
    assert f"refined in {STEPS} steps, interrupted: held-out PSNR" in err
    (path,) = tmp_path.iterdir()  # and the other input is not begun
    assert path.name == "sh2-lod.spz" and read_scene(path).tree is not None


@pytest.mark.slow
def test_ctrl_c_without_a_gain_or_a_second_one_leaves_nothing(tmp_path: Path) -> None:
    err = interrupted(tmp_path, signal.SIGINT, kept=0)
    assert err.endswith("\ninterrupted\n") and "Stopped before --refine improved anything; no file written." in err
    for signals in ((signal.SIGINT, signal.SIGINT), (signal.SIGTERM,), (signal.SIGHUP,)):
        assert interrupted(tmp_path, *signals, heeds=len(signals) == 1) == "interrupted\n"
    assert not list(tmp_path.iterdir())
