"""Messages of all commands: on the console, of faults that nobody foresaw, and of missing packages."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.cli import run
from sparklod_cli.codecs import ply
from sparklod_cli.commands import console as console_module
from sparklod_cli.commands.build_lod import CLAMPED_BY_SPZ
from sparklod_cli.commands.console import Console, count_of, say_error
from sparklod_cli.images.pyvista_scene import load_pyvista
from sparklod_cli.io import reading
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

TREE, PLAIN = FIXTURES / "golden" / "tree-v3.spz", FIXTURES / "one.ply"

#: A plural of one.
ONES = re.compile(r"(?<![\d.,])1 (?:\w+ )?(splats|nodes|levels|leaves|frames|cameras|chunks|texels|rows|instances)\b")


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ("100000x100000", "is too large; give at most 65,536 pixels along a side, such as 1280x720"),
        (f"8x{'9' * 5000}", "is too large"),
        ("8x65537", "is too large"),
        ("8x" + "0" * 5000, "is not a width and a height"),
        ("0x8", "is not a width and a height in pixels, such as 1280x720"),
        ("8", "is not a width and a height"),
        ("8x-8", "is not a width and a height"),
        ("8x²", "is not a width and a height"),
    ],
)
def test_a_wrong_picture_size_is_quoted(size: str, said: str, capsys: Capture) -> None:
    assert run(["render", str(TREE), "--size", size]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert size[:20] in err


@pytest.mark.parametrize(("size", "status"), [("3MB", 0), ("3MiB", 0), ("10", 3), ("0.01kB", 3), ("1GiB", 0)])
def test_sizes_in_assertions_have_units(size: str, status: int) -> None:
    assert run(["inspect", str(TREE), "--assert", f"bytes<={size}"]) == status


@pytest.mark.parametrize("size", ["-1", "3Mbit", "3 apples", "1.5", "3iB"])
def test_a_text_that_is_not_a_size_is_wrong_usage(size: str, capsys: Capture) -> None:
    assert run(["simplify", str(TREE), f"--max-bytes={size}"]) == 2
    assert f"{size!r} is not a size: whole bytes, such as 3000000, 3MB or 3MiB" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first", "said"),
    [
        ("x,y,z,yaw,pitch", "lacks target_x, target_y, target_z; a camera needs x, y, z, and"),
        ("x,y,z,qx,qy,qz", "lacks qw; a camera needs"),
        ("X, Y, target_x, target_y, target_z", "lacks z; a camera needs"),
        ("frame,position,rotation", "lacks x, y, z, target_x, target_y, target_z"),
    ],
)
def test_a_camera_csv_is_told_its_columns(first: str, said: str, tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "cameras.csv"
    path.write_text(f"{first}\n0,0,0,0,0\n")
    for arguments in ([], ["--camera-format", "csv"]):
        assert run(["traverse", str(TREE), "--camera-path", str(path), *arguments]) == 1
        err = capsys.readouterr().err
        assert f"error: {path}: its first line, which names the columns, {said}" in err
        assert "target_x, target_y, target_z or qx, qy, qz, qw" in err


def clamped_scene(tmp_path: Path, **values: float) -> Path:
    """A scene with one splat that has such values."""
    splats = read_scene(FIXTURES / "sh1.ply").splats
    changed = {name: np.array(getattr(splats, name)) for name in values}
    for name, value in values.items():
        changed[name][0] = value
    scene = read_scene(FIXTURES / "sh1.ply")
    path = tmp_path / "clamped.ply"
    path.write_bytes(b"".join(ply.encode(dataclasses.replace(scene, splats=dataclasses.replace(splats, **changed)))))
    return path


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
def test_what_is_clamped_is_said_in_a_line_and_with_verbose_in_detail(
    name: str, value: float, detail: str, consequence: str, tmp_path: Path, capsys: Capture
) -> None:
    source = clamped_scene(tmp_path, **{name: value, "opacity": 0.5})
    assert run(["build-lod", str(source)]) == 0
    _, *lines = capsys.readouterr().err.splitlines()
    expected = [f"  {consequence} than SPZ can hold; --format rad keeps more of them"] if consequence else []
    assert lines == expected
    assert run(["build-lod", str(source), "--overwrite", "-v"]) == 0
    err = capsys.readouterr().err
    advice = CLAMPED_BY_SPZ[name, "above" in detail][1]
    said = re.escape(detail).replace("N", r"\d+ nodes? \(.* %\)")
    assert re.search(rf"\n  {said}, and are clamped to what SPZ holds: {re.escape(advice)}\n", err), err
    assert err.count("clamped to") == 1
    assert "--scale" not in err


def test_a_loss_of_all_splats_is_a_hundred_percent(tmp_path: Path, capsys: Capture) -> None:
    splats = random_splats(1_000)
    splats.scale[:], splats.opacity[:] = 1e-6, 0.5
    source = tmp_path / "dots.ply"
    source.write_bytes(b"".join(ply.encode(Scene(splats))))
    assert run(["build-lod", str(source)]) == 0
    err = capsys.readouterr().err
    assert "  100 % of splats are smaller than SPZ can hold" in err and "e+" not in err


@pytest.mark.parametrize("column", [slice(0, 1), slice(0, 3)])
@pytest.mark.parametrize("count", [0, 1, 2, 300])
def test_the_note_and_inspect_go_by_one_rule(count: int, column: slice, tmp_path: Path, capsys: Capture) -> None:
    """That flat splats get thicker cannot be seen; that whole splats grow can, if they are more than 0.1 %."""
    splats = random_splats(1_000)
    splats.scale[:count, column] = 1e-6
    splats.opacity[:] = 0.5
    source, output = tmp_path / "small.ply", tmp_path / "small-lod.spz"
    source.write_bytes(b"".join(ply.encode(Scene(splats))))
    assert run(["build-lod", str(source), "-o", str(output)]) == 0
    assert ("than SPZ can hold" in capsys.readouterr().err) == (count > 1 and column.stop == 3)
    assert run(["inspect", str(output), "--check", "--json"]) == 0
    codes = [each["code"] for each in json.loads(capsys.readouterr().out)["findings"]]
    assert ("values.scale-clamped" in codes) == (count > 1 and column.stop == 3)


def test_counts_of_one_have_a_singular_noun(tmp_path: Path, capsys: Capture) -> None:
    look = ("--look-at", "0,-1,4:0,0,0", "--size", "8x8")
    lod = tmp_path / "one-lod.spz"
    for arguments in (
        ["build-lod", PLAIN, "-o", lod, "-v"],
        ["convert", lod, tmp_path / "back.ply"],
        ["inspect", PLAIN],
        ["inspect", lod],
        ["inspect", lod, "--assert", "leaves>=2"],
        ["inspect", PLAIN, "--assert", "leaves>=2"],
        ["inspect", lod, "--leaves-of", FIXTURES / "sh1.ply"],
        ["inspect", TREE, "--leaves-of", PLAIN],
        ["traverse", lod, *look, "--summary"],
        ["traverse", lod, TREE, *look, "--budget", 1],
        ["render", lod, *look, "-o", tmp_path / "a.png"],
        ["render", lod, *look, "--compare", "--budget", "1"],
        ["build-lod", PLAIN, "--rgba", FIXTURES / "sh1.ply"],
    ):
        run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert out + err
        assert ONES.search(out + err) is None, (arguments, out, err)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown_on(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, *, quiet: bool = False) -> str:
    monkeypatch.setattr("sys.stderr", stream)
    with Console(quiet=quiet, verbose=False) as console:
        for done in (0, 5, 10):
            console.progress("reading", done, 10, "splat")
        console.progress("writing", 1, 4, "B")
    return stream.getvalue()


def test_a_terminal_gets_a_bar_a_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    text = shown_on(Terminal(), monkeypatch)
    assert "reading:" in text
    assert "splats" in text
    assert "writing:" in text
    assert text.endswith("\r")  # and takes it away


def test_a_file_or_a_quiet_terminal_gets_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown_on(io.StringIO(), monkeypatch) == ""
    assert shown_on(Terminal(), monkeypatch, quiet=True) == ""


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
    assert shares == sorted(shares)
    assert {25, 62, 100} <= set(shares)
    assert " left" in text
    assert "frames" in text  # after the job, a bar of one stage


def test_a_log_gets_how_much_of_a_job_is_done_and_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
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
    """How much of a job is done by the lines of a log, one for each call, 0 to 100."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stderr", log := io.StringIO())
        patch.setattr(console_module, "LOG_INTERVAL", -1)
        with Console(quiet=False, verbose=False) as console, console.job(SHARES):
            for stage, done, total in calls:
                console.progress(stage, done, total, "splat")
    return [float(share) for share in re.findall(r": (\d+) % done", log.getvalue())]


def test_the_stages_of_a_job_have_their_shares() -> None:
    shares = shares_reported([(stage, done, 2) for stage in SHARES for done in (1, 2)])
    assert shares == pytest.approx([100 / 16, 100 / 8, 500 / 16, 50, 75, 100], abs=0.5)


@given(st.lists(st.tuples(st.sampled_from([*SHARES, "compiling"]), st.integers(0, 20), st.integers(0, 10))))
def test_a_job_never_goes_back_nor_beyond_its_end(calls: Calls) -> None:
    shares, last = shares_reported(calls), 0.0
    assert len(shares) == len(calls)
    for (stage, _, _), share in zip(calls, shares, strict=True):
        assert last <= share <= 100
        if stage == "compiling":
            assert share == last
        last = share


def test_colour_is_for_terminals_that_want_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value, colour in (("NO_COLOR", "", True), ("NO_COLOR", "1", False), ("TERM", "dumb", False)):
        with monkeypatch.context() as patch:
            patch.delenv("NO_COLOR", raising=False)
            patch.setenv("TERM", "xterm")
            patch.setenv(name, value)
            patch.setattr("sys.stderr", stream := Terminal())
            say_error("no")
            assert ("\x1b[31m" in stream.getvalue()) == colour


def test_counts_are_said_properly() -> None:
    assert [count_of(n, "node") for n in (0, 1, 1234)] == ["0 nodes", "1 node", "1,234 nodes"]


SCENE = FIXTURES / "one.ply"
Break = Callable[[BaseException], None]


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Break:
    """Makes the reading of any file end in an exception."""

    def end_in(error: BaseException) -> None:
        def fail(*args: object, **kwargs: object) -> None:
            raise error

        monkeypatch.setattr(reading, "open_splats", fail)

    return end_in


@pytest.mark.parametrize("command", ["build-lod", "convert", "inspect", "inspect --check", "render"])
@pytest.mark.parametrize(
    "error",
    [ZeroDivisionError("division\nby zero"), EOFError("cut"), AssertionError(), KeyError("x"), StopIteration(1)],
)
def test_a_bug_is_one_line_that_asks_for_a_report(
    command: str, error: Exception, broken: Break, tmp_path: Path, capsys: Capture
) -> None:
    broken(error)
    out = {"build-lod": ["-o", f"{tmp_path}/out.spz"], "convert": [f"{tmp_path}/a.ply"], "render": ["-o", "a.png"]}
    assert run([*command.split(), str(SCENE), *out.get(command, [])]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: sparklod failed in a way that it should not: ")
    assert type(error).__name__ in line
    assert "please report" in line
    assert "-v shows" in line
    assert not list(tmp_path.iterdir())


def test_verbose_shows_the_traceback_before_the_error(broken: Break, capsys: Capture) -> None:
    broken(ZeroDivisionError("division by zero"))
    assert run(["inspect", str(SCENE), "-v"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-2] == "ZeroDivisionError: division by zero"
    assert lines[-1].startswith("error: sparklod failed")
    assert "-v shows" not in lines[-1]
    assert run(["inspect", str(SCENE)]) == 1  # what one run was told does not last
    assert "Traceback" not in capsys.readouterr().err


def test_the_line_of_a_bug_is_short_and_printable(broken: Break, capsys: Capture) -> None:
    broken(RuntimeError("\x1b[31m" + "x" * 100_000))
    assert run(["inspect", str(SCENE)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "\x1b" not in line
    assert len(line) < 400


def test_an_interruption_is_not_reported_as_a_bug(broken: Break, capsys: Capture) -> None:
    broken(KeyboardInterrupt())
    assert run(["inspect", str(SCENE)]) == 130
    assert capsys.readouterr().err.strip() == "interrupted"
    broken(SystemExit(7))
    with pytest.raises(SystemExit) as caught:
        run(["inspect", str(SCENE)])
    assert caught.value.code == 7


@pytest.mark.parametrize(
    ("package", "command"),
    [
        ("matplotlib", ["traverse", "missing.spz", "--plot", "x.png"]),
        ("matplotlib", ["render", "missing.spz", "--compare", "--plot", "x.png"]),
        ("pyvista", ["inspect", "missing.spz", "--plot", "x.png"]),
        ("pyarrow", ["traverse", "missing.spz", "-o", "x.parquet"]),
        ("pyarrow", ["render", "missing.spz", "--compare", "-o", "x.parquet"]),
        ("pyarrow", ["inspect", "missing.spz", "--chunks-out", "x.parquet"]),
    ],
)
def test_a_missing_package_is_reported_before_the_work(
    package: str,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    load_pyvista.cache_clear()
    assert run(command) == 1
    err = capsys.readouterr().err
    assert f" need{'s' if package != 'pyvista' else ''} {package}: " in err
    assert "missing.spz" not in err
    assert not any(tmp_path.iterdir())


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
