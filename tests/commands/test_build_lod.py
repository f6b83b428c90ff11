"""`sparklod build-lod`: trees, options, records, transforms, standard streams, signals, and failures of some inputs."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.model.transforms import Transform
from sparklod_cli.system.stdio import spooled
from tests.commands.cli import NAMED, Cli, process
from tests.conftest import FIXTURES, ROOT
from tests.signals import heed_signals

SMALL = "sh2.ply"


def scene_of(name: str) -> Scene:
    return read_scene(Path(name))


def leaves(name: str) -> Splats:
    scene = scene_of(name)
    assert scene.tree is not None
    return scene.splats.take(scene.tree.is_leaf)


# --- Records and messages ---------------------------------------------------------------------------------------------


def test_an_input_is_baked_beside_itself(cli: Cli) -> None:
    done = cli(f"build-lod {SMALL}")
    nodes = len(scene_of("sh2-lod.spz"))
    assert done.out == ""
    assert f"{len(leaves('sh2-lod.spz')):,} splats, SH 2  ->  sh2-lod.spz  {nodes:,} nodes" in done.err
    assert cli(f"build-lod {SMALL} -qf")[1:] == ("", "")
    assert "fractional bits; read" in cli(f"build-lod {SMALL} -vf").err


def test_a_failure_does_not_stop_the_others(cli: Cli) -> None:
    cli.put("broken.ply", b"ply\nnonsense\nend_header\n")
    done = cli(f"build-lod missing.ply one.ply broken.ply {SMALL} --output-dir new/web --json", status=1)
    assert "error: missing.ply: cannot be read: no such file or directory\n" in done.err
    assert "error: broken.ply: bad PLY header" in done.err and done.err.count("error:") == 2
    assert cli.made() == ["new/web/one-lod.spz", "new/web/sh2-lod.spz"]
    assert ["error" in record for record in done.records] == [True, False, True, False]
    reason = "cannot be read: no such file or directory"
    assert done.records[0] == {"schema_version": 1, "input": "missing.ply", "error": reason}


def test_json_is_a_record_of_the_tree(cli: Cli) -> None:
    record = cli(f"build-lod {SMALL} --json -q --base 2 --max-sh 1").json
    assert (record["input"], record["output"]) == (SMALL, "sh2-lod.spz")
    assert record["bytes"] == Path("sh2-lod.spz").stat().st_size
    assert record["nodes"] == len(scene_of("sh2-lod.spz"))
    assert (record["splats"], record["sh_degree"], record["dropped"]) == (60, 1, {})
    assert set(record["seconds"]) == {"read", "build", "write"}
    assert record["refine"] is record["detail"] is record["blocks"] is record["scratch_bytes_written"] is None


def test_a_file_that_may_not_be_read_does_not_stop_the_others(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = cli.put("closed.ply", NAMED[SMALL].read_bytes())
    opened, access = Path.open, os.access

    def refused(path: Path, *args: object, **kwargs: object) -> object:
        if path.name == closed.name:
            raise PermissionError(13, "Permission denied")
        return opened(path, *args, **kwargs)  # type: ignore[call-overload]

    # As for anybody but root, whom a test may be run by.
    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(
        os, "access", lambda path, *a, **how: Path(path).name != closed.name and access(path, *a, **how)
    )
    done = cli(f"build-lod {SMALL} closed.ply one.ply --output-dir web", status=1)
    assert "error: closed.ply: cannot be read: permission denied\n" in done.err
    assert cli.made() == ["web/one-lod.spz", "web/sh2-lod.spz"]
    said = "closed.ply: error: file.unreadable: cannot be read: permission denied\n"
    assert said in cli("inspect closed.ply one.ply --check", status=3).out
    cli("inspect one.ply closed.ply", status=1)


def test_properties_of_the_file_are_kept_or_their_loss_is_reported(cli: Cli) -> None:
    assert "SH degree 4 is cut to 3" in cli("build-lod hand-v4.spz hand-v4-sh4.spz --output-dir ./").err
    for name in ("hand-v4", "hand-v4-sh4"):
        assert scene_of(f"{name}-lod.spz").antialiased == scene_of(f"{name}.spz").antialiased
    assert scene_of("hand-v4.spz").antialiased


# --- Options ----------------------------------------------------------------------------------------------------------


def test_options_of_spz_reach_the_file(cli: Cli) -> None:
    record = cli(f"build-lod {SMALL} -o a.spz --json --spz-version 2 --fractional-bits 9").json
    assert (record["version"], record["fractional_bits"]) == (2, 9)
    assert scene_of("a.spz").format == "SPZ 2 LoD"
    for suffix in ("spz", "rad"):
        for level in (1, 9):
            cli(f"build-lod sh3.ply -o {level}.{suffix} --compression-level {level}")
        assert Path(f"9.{suffix}").stat().st_size < Path(f"1.{suffix}").stat().st_size


def test_builders_have_sizes_of_their_own_and_quick_is_the_default(cli: Cli) -> None:
    sizes = {}
    for name, options in (
        *(("default", ""), ("quick", "--method quick"), ("base 1.1", "--base 1.1"), ("base 2", "--base 2")),
        *((f"growth {growth}", f"--method quality --growth {growth}") for growth in (1.05, 1.2, 2.0)),
    ):
        done = cli(f"build-lod {SMALL} -o '{name}.spz' --json -v {options}")
        tree = scene_of(f"{name}.spz").tree
        assert tree is not None
        tree.validate()
        sizes[name] = len(tree)
        method = "quality" if "growth" in name else "quick"
        assert (done.json["method"], done.json["nodes"]) == (method, len(tree))
        assert f"PLY -> {method} tree -> SPZ 3 LoD" in done.err
        if method == "quality":
            assert tree.is_leaf.sum() == 60 and len(tree) <= float(name.split()[1]) * 60
    assert Path("default.spz").read_bytes() == Path("quick.spz").read_bytes()
    assert sizes["base 1.1"] > sizes["base 2"]
    assert sizes["growth 1.05"] < sizes["growth 1.2"] < sizes["growth 2.0"]


@pytest.mark.parametrize("method", METHODS)
def test_threads_do_not_change_the_file(method: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    for threads in (1, 2):
        cli(f"build-lod demo.ply -o {threads}.spz --method {method} --threads {threads}")
    assert Path("1.spz").read_bytes() == Path("2.spz").read_bytes()
    monkeypatch.setattr("sparklod_cli.system.threads.processors", lambda: 5000)  # more than the most threads
    cli(f"build-lod {SMALL}")


def test_selected_splats_are_counted_and_the_others_by_reason(cli: Cli) -> None:
    splats = read_scene(NAMED[SMALL]).splats
    x, y, z = splats.center[0].tolist()
    distance = np.sqrt(((splats.center - splats.center[0]) ** 2).sum(axis=1, dtype=np.float64))
    radius, opacity = float(np.median(distance)), float(np.median(splats.opacity))
    for option, selected in (
        (f"--within {x},{y},{z},{radius}", distance <= radius),
        (f"--min-box {x},{y},{z}", (splats.center >= splats.center[0]).all(axis=1)),
        (f"--max-box {x},1e9,1e9", splats.center[:, 0] <= splats.center[0, 0]),
        (f"--min-opacity {opacity}", splats.opacity >= opacity),
    ):
        done = cli(f"build-lod {SMALL} -o a.spz -f --json {option}")
        count, left_out = int(selected.sum()), int((~selected).sum())
        assert (done.json["read"], done.json["splats"]) == (len(splats), count)
        assert [*done.json["dropped"].values()] == [left_out], option
        assert f"left out: {left_out} " in done.err
    cli(f"build-lod {SMALL} -o a.spz -f --max-sh 0")
    assert scene_of("a.spz").splats.sh_degree == 0


def test_a_bake_of_a_ply_loads_no_other_reader(tmp_path: Path) -> None:
    """Nor what only bakes out of core, of other outputs, or of several files need."""
    line = f"build-lod {NAMED['sh3.ply']} -o {tmp_path}/a.spz -q"
    code = f"import sys; from sparklod_cli import cli; assert cli.run({line.split()!r}) == 0; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "sparklod_cli.codecs.ply" in loaded and "PIL" not in loaded
    others = ("cameras.colmap", "codecs.sog", "codecs.streamed_manifest", "codecs.rad.rad_writer")
    others += ("codecs.layouts", "bake.cluster", "bake.in_blocks", "bake.skipping")
    assert not {f"sparklod_cli.{name}" for name in (*others, "viewers.instances_file")}.intersection(loaded)


# --- Transforms -------------------------------------------------------------------------------------------------------

TRANSFORMS: dict[str, dict[str, Any]] = {
    "--up -y": {"up": "-y"},
    "--rotate 25,-70,130": {"rotate": (25, -70, 130)},
    "--translate -3,0.5,2": {"translate": (-3, 0.5, 2)},
    "--up z --rotate 0,90,0 --scale 2.5 --translate 1,2,3": {
        "up": "z",
        "rotate": (0, 90, 0),
        "scale": 2.5,
        "translate": (1, 2, 3),
    },
}


@pytest.mark.parametrize("options", TRANSFORMS)
def test_the_leaves_are_the_splats_transformed(options: str, cli: Cli) -> None:
    for name, more in (("before", ""), ("after", options)):
        cli(f"build-lod sh3.ply -o {name}.spz --fractional-bits 12 {more}")
    found, expected = leaves("after.spz"), Transform.from_parts(**TRANSFORMS[options]).apply(leaves("before.spz"))
    found, expected = (splats.take(np.lexsort(splats.rgb.T)) for splats in (found, expected))
    # Both were rounded to SPZ's codes, before the transform or after it; opacities make up for the rounding of scales.
    for column, most in (("center", 0.001), ("opacity", 0.1), ("rgb", 0), ("sh", 0.2)):
        np.testing.assert_allclose(getattr(found, column), getattr(expected, column), atol=most, err_msg=column)
    np.testing.assert_allclose(found.scale, expected.scale, rtol=0.07)
    assert np.abs(np.einsum("ij,ij->i", found.quat_xyzw, expected.quat_xyzw)).min() > 0.999


def test_a_transform_that_does_nothing_changes_nothing_and_selection_comes_first(cli: Cli) -> None:
    for name, options in (
        *(("a", ""), ("b", "--up y --rotate 0,0,0 --scale 1")),
        *(("c", "--min-box 0,-9,-9"), ("d", "--min-box 0,-9,-9 --translate -100,0,0")),
    ):
        cli(f"build-lod sh3.ply -o {name}.spz {options}")
    for column in COLUMNS:
        np.testing.assert_array_equal(*(getattr(scene_of(f"{name}.spz").splats, column) for name in "ab"))
    assert len(leaves("c.spz")) == len(leaves("d.spz")) < len(scene_of("sh3.ply"))


# --- Standard streams -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["sh2.ply", "sh1-ascii.ply", "sh3-v2.sog", "sh2-level1.ksplat", "hand-v4.spz"])
def test_the_bytes_of_a_file_give_the_same_tree_as_the_file(name: str, cli: Cli) -> None:
    assert cli("build-lod - -o piped.spz --json", stdin=NAMED[name].read_bytes()).json["input"] == "-"
    cli(f"build-lod {name} -o named.spz")
    assert Path("piped.spz").read_bytes() == Path("named.spz").read_bytes()
    cli("convert - piped.ply", stdin=Path("piped.spz").read_bytes())
    cli("convert named.spz named.ply")
    assert Path("piped.ply").read_bytes() == Path("named.ply").read_bytes()


def test_a_process_reads_and_writes_pipes(cli: Cli) -> None:
    done = process("build-lod - -o -", input=NAMED[SMALL].read_bytes())
    assert done.returncode == 0, done.stderr
    cli(f"build-lod {SMALL} -o named.spz")
    assert done.stdout == Path("named.spz").read_bytes()
    assert b"standard input  " in done.stderr and b"->  standard output" in done.stderr
    script = f"{sys.executable} -m sparklod_cli build-lod {SMALL} -o - >&-"
    closed = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert closed.returncode == 1 and closed.stderr.endswith(f"error: {SMALL}: standard output is closed\n")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "error: standard input: the file is empty"),
        (b"hello", "error: standard input: not a splat file that sparklod reads"),
        (NAMED["sh0.splat"].read_bytes(), ".hier or .splat is not recognised by its content"),
        (NAMED[SMALL].read_bytes()[:-9], "error: standard input: "),
        (b'{"version": 2, "means": {"files": ["means_l.webp", "means_u.webp"]}}', "error: standard input: "),
    ],
)
def test_errors_name_standard_input(data: bytes, message: str, cli: Cli) -> None:
    assert message in cli("build-lod - -o a.spz", stdin=data, status=1).err
    assert cli.made() == []


def test_standard_input_is_no_terminal_and_can_be_read_twice(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    for data in (b"first", b"second"):
        with mock.patch("sys.stdin", io.TextIOWrapper(io.BytesIO(data))):
            assert [spooled().read() for _ in range(2)] == [data, data]
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO()))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    assert "standard input is a terminal; pipe a file into it" in cli("build-lod - -o a.spz", status=1).err
    monkeypatch.setattr("sys.stdin", None)
    assert "standard input is closed" in cli("build-lod - -o a.spz", status=1).err


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_read_as_standard_input(cli: Cli) -> None:
    os.mkfifo("pipe.ply")
    said = "give - to build-lod, simplify or inspect: - reads standard input"
    assert said in cli("build-lod pipe.ply", status=1).err


def handles(process: int, how: signal.Signals) -> bool:
    """Return whether a process has its own handler for SIGTERM and a signal; Python itself has one for SIGINT."""
    status = Path(f"/proc/{process}/status")
    if not status.exists():
        time.sleep(0.4)
        return True
    caught = int(re.search(r"SigCgt:\s*(\w+)", status.read_text())[1], 16)  # type: ignore[index]
    return all(caught >> number - 1 & 1 for number in (how, signal.SIGTERM))


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interruption_leaves_nothing_behind(tmp_path: Path, how: signal.Signals) -> None:
    line = f"build-lod {FIXTURES / 'demo.ply'} --output-dir {tmp_path} -q"
    command = [sys.executable, "-m", "sparklod_cli", *line.split()]
    # Wherever it is caught: while it imports, reads, compiles, builds or writes. Before that it is Python's to handle.
    for delay in (0.05, 0.3, 0.6):
        running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, preexec_fn=heed_signals)
        while running.poll() is None and not handles(running.pid, how):
            time.sleep(0.01)
        time.sleep(delay)
        running.send_signal(how)
        _, err = running.communicate()
        assert running.returncode in (0, 130, -how), err  # -how: while Python left
        left = list(tmp_path.iterdir())
        if left:  # it was done before, or all but done
            assert [path.name for path in left] == ["demo-lod.spz"]
            assert read_scene(left[0]).tree is not None
            left[0].unlink()
        else:
            assert running.returncode != 0
        assert b"Exception ignored" not in err
