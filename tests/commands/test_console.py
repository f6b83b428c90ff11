"""Messages on the console: losses, counts, progress, bugs, missing packages, and memory that runs out."""

from __future__ import annotations

import dataclasses
import errno
import io
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.codecs import spz
from sparklod_cli.codecs.formats import WriteOptions
from sparklod_cli.commands import console as console_module
from sparklod_cli.commands.build_lod import ADVICE
from sparklod_cli.commands.console import Console, count_of, say_error
from sparklod_cli.images.pyvista_scene import load_pyvista
from sparklod_cli.inspection import tree
from sparklod_cli.io import files, reading
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from sparklod_cli.system.errors import out_of_memory
from tests.commands.cli import NAMED, Cli
from tests.conftest import ROOT
from tests.scenes import random_splats

# --- Losses and counts ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("first", "said"),
    [
        ("x,y,z,yaw,pitch", "lacks target_x, target_y, target_z; a camera needs x, y, z, and"),
        ("x,y,z,qx,qy,qz", "lacks qw; a camera needs"),
        ("X, Y, target_x, target_y, target_z", "lacks z; a camera needs"),
        ("frame,position,rotation", "lacks x, y, z, target_x, target_y, target_z"),
    ],
)
def test_a_camera_csv_without_a_column_is_told_all_columns(first: str, said: str, cli: Cli) -> None:
    cli.put("cameras.csv", f"{first}\n0,0,0,0,0\n")
    for options in ("", "--camera-format csv"):
        err = cli(f"traverse tree-v3.spz --camera-path cameras.csv {options}", status=1).err
        assert f"error: cameras.csv: its first line, which names the columns, {said}" in err
        assert "target_x, target_y, target_z or qx, qy, qz, qw" in err


@pytest.mark.parametrize(
    ("name", "value", "detail", "consequence"),
    [
        ("scale", 1e-7, "scales of N are below 4.4e-05, down to 1e-07", "1.7 % of splats are smaller"),
        ("scale", 4e3, "scales of N are above 391, up to 4e+03", "1.7 % of splats are larger"),
        ("rgb", -3.0, "colours of N are below -0.444, down to -3", ""),  # black is black
        ("rgb", 4.0, "colours of N are above 1.44, up to 4", "1.7 % of colours are brighter"),
        ("sh", -2.0, "SH of N are below -1, down to -2", ""),  # too few to be seen
        ("sh", 2.5, "SH of N are above 0.996, up to 2.5", ""),
    ],
)
def test_clamped_values_are_one_line_and_verbose_has_details(
    name: str, value: float, detail: str, consequence: str, cli: Cli
) -> None:
    splats = read_scene(NAMED["sh1.ply"]).splats
    changed = {column: np.array(getattr(splats, column)) for column in (name, "opacity")}
    changed[name][0], changed["opacity"][0] = value, 0.5
    cli.put("a.ply", dataclasses.replace(splats, **changed))
    _, *lines = cli("build-lod a.ply").err.splitlines()
    assert lines == [f"  {consequence} than SPZ can hold; --format rad keeps more of them"] * bool(consequence)
    err = cli("build-lod a.ply --overwrite -v").err
    advice = ADVICE["SPZ", name]["above" in detail]
    said = re.escape(detail).replace("N", r"\d+ nodes? \(.* %\)")
    assert re.search(rf"\n  {said}, and are clamped to what SPZ holds: {re.escape(advice)}\n", err), err
    assert err.count("clamped to") == 1 and "--scale" not in err


@pytest.mark.parametrize("column", [slice(0, 1), slice(0, 3)])
@pytest.mark.parametrize("count", [0, 1, 2, 300, 1000])
def test_the_note_and_inspect_go_by_one_rule(count: int, column: slice, cli: Cli) -> None:
    """That flat splats get thicker cannot be seen; that whole splats grow can, if they are more than 0.1 %."""
    splats = random_splats(1_000)
    splats.scale[:count, column] = 1e-6
    splats.opacity[:] = 0.5
    cli.put("small.ply", splats)
    err = cli("build-lod small.ply").err
    is_noted = count > 1 and column.stop == 3
    assert ("than SPZ can hold" in err) == is_noted
    assert count < 1000 or not is_noted or ("  100 % of splats are smaller than SPZ" in err and "e+" not in err)
    report = cli("inspect small-lod.spz --check --json").json
    assert ("values.scale-clamped" in [each["code"] for each in report["findings"]]) == is_noted


def test_counts_of_one_have_a_singular_noun(cli: Cli) -> None:
    look = "--look-at 0,-1,4:0,0,0 --size 8x8"
    nouns = "splats|nodes|levels|leaves|frames|cameras|chunks|texels|rows|instances"
    cli("build-lod one.ply -o lod.spz")
    for line in (
        "build-lod one.ply -o lod.spz -v -f",
        "convert lod.spz back.ply",
        "inspect one.ply",
        "inspect lod.spz",
        "inspect lod.spz --assert leaves>=2",
        "inspect one.ply --assert leaves>=2",
        "inspect lod.spz --leaves-of sh1.ply",
        "inspect tree-v3.spz --leaves-of one.ply",
        f"traverse lod.spz {look} --summary",
        f"traverse lod.spz tree-v3.spz {look} --budget 1",
        f"render lod.spz {look} -o a.png",
        f"render lod.spz {look} --compare --budget 1",
        "build-lod one.ply --rgba sh1.ply",
    ):
        done = cli(line, status=None)
        text = done.out + done.err
        assert text and re.search(rf"(?<![\d.,])1 (?:\w+ )?({nouns})\b", text) is None, (line, text)
    assert [count_of(n, "node") for n in (0, 1, 1234)] == ["0 nodes", "1 node", "1,234 nodes"]


# --- Progress ---------------------------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_a_stage_and_a_file_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream, quiet, has_bars in (
        (Terminal(), False, True),
        (io.StringIO(), False, False),
        (Terminal(), True, False),
    ):
        monkeypatch.setattr("sys.stderr", stream)
        with Console(quiet=bool(quiet), verbose=False) as console:
            for done in (0, 5, 10):
                console.progress("reading", done, 10, "splat")
            console.progress("writing", 1, 4, "B")
        text = stream.getvalue()
        if has_bars:
            assert "reading:" in text and "splats" in text and "writing:" in text
            assert text.endswith("\r")  # and takes it away
        else:
            assert text == ""


@pytest.mark.parametrize("quiet", [False, True])
def test_a_log_gets_a_line_of_a_long_stage_every_ten_seconds(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    log, clock = io.StringIO(), iter([0, 4, 9, 11, 15, 22, 29, 33, 100, 104, 109])
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr(console_module, "monotonic", lambda: next(clock))
    with Console(quiet=quiet, verbose=False) as console:
        for done in range(8):
            console.progress("refining", 250 * done, 1750, "step")
        for done in range(3):
            console.progress("writing", done, 4, "B")
    lines = ["refining: 750 of 1,750 steps (43 %), 11 s", "refining: 1,250 of 1,750 steps (71 %), 22 s"]
    assert log.getvalue().splitlines() == ([] if quiet else lines)


def test_a_job_of_several_stages_is_one_bar_with_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", stream := Terminal())
    with Console(quiet=False, verbose=False) as console:
        with console.job({"reading": 1, "writing": 3}):
            for stage, done in (("reading", 0), ("reading", 2), ("writing", 1), ("writing", 2)):
                console.progress(stage, done, 2, "splat")
                console.say(f"{stage} {done}")  # which takes the bar away and brings it back
        console.progress("comparing", 1, 2, "frame")
    text = stream.getvalue()
    shares = [int(share) for share in re.findall(r"(?:reading|writing): +(\d+)%", text)]
    assert shares == sorted(shares) and {25, 62, 100} <= set(shares)
    assert " left" in text and "frames" in text  # after the job, a bar of one stage


def test_a_log_gets_the_share_of_a_job_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    log, clock = io.StringIO(), iter([0, 4, 12, 15, 60])
    monkeypatch.setattr("sys.stderr", log)
    monkeypatch.setattr(console_module, "monotonic", lambda: next(clock))
    with Console(quiet=False, verbose=False) as console, console.job({"reading": 1, "writing": 3}):
        for stage, done in (("reading", 0), ("reading", 2), ("writing", 1), ("writing", 1)):
            console.progress(stage, done, 2, "splat")
    lines = ["reading: 25 % done after 12 s, about 36 s left", "writing: 62 % done after 1 min, about 36 s left"]
    assert log.getvalue().splitlines() == lines


SHARES = {"reading": 1.0, "building": 3.0, "writing": 4.0}
Calls = list[tuple[str, int, int]]


def shares_reported(calls: Calls) -> list[float]:
    """Return the percentages in the lines of a log, one for each call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", log := io.StringIO())
        patch.setattr(console_module, "LOG_INTERVAL", -1)
        with Console(quiet=False, verbose=False) as console, console.job(SHARES):
            for stage, done, total in calls:
                console.progress(stage, done, total, "splat")
    return [float(share) for share in re.findall(r": (\d+) % done", log.getvalue())]


@given(st.lists(st.tuples(st.sampled_from([*SHARES, "compiling"]), st.integers(0, 20), st.integers(0, 10))))
def test_a_job_never_goes_back_nor_beyond_its_end(calls: Calls) -> None:
    shares, last = shares_reported(calls), 0.0
    assert len(shares) == len(calls)
    for (stage, _, _), share in zip(calls, shares, strict=True):
        assert last <= share <= 100
        assert stage != "compiling" or share == last
        last = share
    expected = [100 / 16, 100 / 8, 500 / 16, 50, 75, 100]
    assert shares_reported([(stage, done, 2) for stage in SHARES for done in (1, 2)]) == pytest.approx(
        expected, abs=0.5
    )


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value, colour in (("NO_COLOR", "", True), ("NO_COLOR", "1", False), ("TERM", "dumb", False)):
        with monkeypatch.context() as patch:
            patch.delenv("NO_COLOR", raising=False)
            patch.setenv("TERM", "xterm")
            patch.setenv(name, value)
            patch.setattr("sys.stderr", stream := Terminal())
            say_error("no")
            assert ("\x1b[31m" in stream.getvalue()) == colour


def test_a_line_that_is_too_long_for_a_terminal_goes_on_below(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    long = "a.ply  152,746 splats, SH 0  ->  a-lod.spz  179,140 nodes, depth 16, 2.9 MB, 7.7 s"
    Console(quiet=False, verbose=False).say(long)
    monkeypatch.setattr("os.get_terminal_size", lambda _: os.terminal_size((80, 24)))
    Console(quiet=False, verbose=False).say(long)
    Console(quiet=False, verbose=False).say(long[:80])
    split = long.index("7.7 s")
    assert capfd.readouterr().err.splitlines() == [long, long[: split - 1], f"    {long[split:]}", long[:80]]


# --- Bugs and missing packages ----------------------------------------------------------------------------------------

Break = Callable[[BaseException], None]


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Break:
    """Makes the reading of any file end in an exception."""

    def end_in(error: BaseException) -> None:
        def fail(*args: object, **kwargs: object) -> None:
            raise error

        for module in (files, reading):
            monkeypatch.setattr(module, "open_splats", fail)

    return end_in


@pytest.mark.parametrize(
    "error",
    [
        *(ZeroDivisionError("division\nby zero"), EOFError("cut"), AssertionError(), KeyError("x"), StopIteration(1)),
        RuntimeError("\x1b[31m" + "x" * 100_000),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_bug_is_one_line_that_asks_for_a_report(error: Exception, broken: Break, cli: Cli) -> None:
    broken(error)
    for line in ("build-lod -o a.spz", "convert one.ply a.ply", "inspect", "inspect --check", "render -o a.png"):
        (said,) = cli(line if "one" in line else f"{line} one.ply", status=1).err.splitlines()
        assert said.startswith("error: sparklod failed in a way that it should not: ")
        assert type(error).__name__ in said and "please report" in said and "-v shows" in said
        assert "\x1b" not in said and len(said) < 400 and cli.made() == []


def test_verbose_shows_the_traceback_before_the_error(broken: Break, cli: Cli) -> None:
    broken(ZeroDivisionError("division by zero"))
    lines = cli("inspect one.ply -v", status=1).err.splitlines()
    assert lines[0].startswith("Traceback") and lines[-2] == "ZeroDivisionError: division by zero"
    assert lines[-1].startswith("error: sparklod failed") and "-v shows" not in lines[-1]
    assert "Traceback" not in cli("inspect one.ply", status=1).err  # -v of one run does not last


def test_an_interruption_is_not_reported_as_a_bug(broken: Break, cli: Cli) -> None:
    broken(KeyboardInterrupt())
    assert cli("inspect one.ply", status=130).err.strip() == "interrupted"
    broken(SystemExit(7))
    with pytest.raises(SystemExit) as caught:
        cli("inspect one.ply")
    assert caught.value.code == 7


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("matplotlib", "traverse missing.spz --plot x.png"),
        ("matplotlib", "render missing.spz --compare --plot x.png"),
        ("pyvista", "inspect missing.spz --plot x.png"),
        ("pyarrow", "traverse missing.spz -o x.parquet"),
        ("pyarrow", "render missing.spz --compare -o x.parquet"),
        ("pyarrow", "inspect missing.spz --chunks-out x.parquet"),
    ],
)
def test_a_missing_package_is_reported_before_the_work(
    package: str, line: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    load_pyvista.cache_clear()
    err = cli(line, status=1).err
    assert f" need{'s' if package != 'pyvista' else ''} {package}: " in err
    assert "missing.spz" not in err and cli.made() == []


# --- Memory -----------------------------------------------------------------------------------------------------------

#: Runs a command twice: with something small HERE, so that all code is loaded and compiled, then with something large
#: and no room but for some megabytes more.
LIMITED = """
import re, resource, sys
from pathlib import Path
from sparklod_cli.cli import run
room, small, large, *command = sys.argv[1:]
assert run([small if word == "HERE" else word for word in command]) == 0
sys.stderr.write("---\\n")
sys.stderr.flush()
taken = int(re.search(r"VmSize:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1]) << 10
resource.setrlimit(resource.RLIMIT_AS, (taken + (int(room) << 20),) * 2)
sys.exit(run([large if word == "HERE" else word for word in command] + ["--overwrite"] * ("-o" in command)))
"""

linux = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and counted as Linux does")

#: Splats of files whose floats take more than eighty megabytes.
COUNT = 1_500_000


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A .splat file and a tree of very many nodes."""
    folder = tmp_path_factory.mktemp("large")
    plain, nodes = folder / "plain.splat", folder / "tree.spz"
    rows = np.zeros((COUNT, 32), np.uint8)
    rows[:, :24].view("<f4")[:] = np.random.default_rng(1).random((COUNT, 6), np.float32) + 0.1
    rows[:, 24:] = 200
    plain.write_bytes(rows.tobytes())
    splats = Splats.empty(COUNT, 0)
    for name, value in (("center", 1), ("scale", 0.1), ("quat_xyzw", 0.5), ("opacity", 0.5), ("rgb", 0.5)):
        getattr(splats, name)[:] = value
    fan = 1500
    count, start = np.zeros(COUNT, np.uint16), np.zeros(COUNT, np.uint32)
    inner = np.arange(-(-(COUNT - 1) // fan))
    count[inner] = np.minimum(fan, COUNT - 1 - inner * fan)
    start[inner] = 1 + inner * fan
    nodes.write_bytes(b"".join(spz.encode(Scene(splats, LodTree(count, start)), WriteOptions(compression_level=1))))
    return plain, nodes


def limited(folder: Path, room: int, small: object, large: object, line: str) -> str:
    """Return the one line of standard error of the run that has no room."""
    words = line.format(out=folder / "out").split()
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(room), str(small), str(large), *words],
        cwd=ROOT,
        env={**os.environ, "MALLOC_ARENA_MAX": "1"},  # threads' arenas reserve room that a limited run could use
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert "---\n" in done.stderr, done.stderr
    lines = done.stderr.partition("---\n")[2].splitlines()
    assert (done.returncode, len(lines)) == (1, 1), lines
    return lines[0]


@linux
@pytest.mark.slow
@pytest.mark.parametrize(
    ("room", "line"),
    [
        (16, "build-lod HERE -o {out}.spz --threads 2"),
        (16, "build-lod HERE -o {out}.spz --threads 1"),
        (100, "build-lod HERE -o {out}.spz --method quality"),
        (16, "convert HERE {out}.spz --leaves --overwrite"),
        (16, "inspect HERE --stats --threads 2"),
        (16, "inspect HERE --check"),
        (16, "traverse HERE --budget 100 --orbit 2 -o {out}.csv"),
        (16, "render HERE --size 32x32 --threads 2 -o {out}.png"),
    ],
)
def test_a_file_too_large_for_memory_is_one_error_that_names_it(
    room: int, line: str, large: tuple[Path, Path], tmp_path: Path
) -> None:
    plain = line.startswith("build-lod")
    small, file = (NAMED["sh0.splat"], large[0]) if plain else (NAMED["hand-tree-v3.spz"], large[1])
    said = limited(tmp_path, room, small, file, line)
    assert said.startswith(f"error: {file}: ") and "it does not fit into memory" in said
    assert not [path for path in tmp_path.iterdir() if path.stem != "out"]  # which the small file's run left


@linux
def test_a_picture_too_large_for_memory_is_an_error_with_its_size(tmp_path: Path) -> None:
    line = f"render {NAMED['hand-tree-v3.spz']} --size HERE -o {{out}}.png"
    said = limited(tmp_path, 200, "32x32", "8000x8000", line)
    assert "it does not fit into memory: 8,000 x 8,000 x" in said


def test_a_file_too_large_for_memory_does_not_stop_the_others(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_once(whole: Callable[..., object]) -> Callable[..., object]:
        errors = [MemoryError()]

        def build(*args: object, **kwargs: object) -> object:
            if errors:
                raise errors.pop()
            return whole(*args, **kwargs)

        return build

    monkeypatch.setattr(tree, "examine", full_once(tree.examine))
    monkeypatch.setattr(quick, "build", full_once(quick.build))
    for line in ("inspect hand-tree-v3.spz hand-tree-v3.spz --check", "build-lod sh0.ply one.ply"):
        first, second = cli(line, status=1).err.splitlines()
        assert first.startswith(f"error: {line.split()[1]}: it does not fit into memory")
        assert not second.startswith("error")


def test_every_way_in_which_memory_runs_out_is_recognised() -> None:
    for error in (
        MemoryError(),
        MemoryError("Allocation failed (probably too large)."),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("libx.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
    ):
        assert str(out_of_memory(error)).startswith("it does not fit into memory; ")
    for other in (RuntimeError("no"), OSError(errno.ENOSPC, "No space left"), ImportError("no module"), ValueError()):
        assert out_of_memory(other) is None
    with pytest.raises(MemoryError) as caught:
        np.empty((8000, 10**12, 4), np.float32)
    assert "8,000 x 1,000,000,000,000 x 4 numbers (float32) take 128,000,000.0 GB" in str(out_of_memory(caught.value))
