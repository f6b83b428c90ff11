"""`sparklod build-lod --memory`, `--scratch-dir`, `--resume` and `--skip-existing`."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import pytest

from sparklod_cli.bake import estimate
from sparklod_cli.bake.flow import SCRATCH as SUFFIX
from sparklod_cli.io.reading import read_scene
from tests.commands.build_lod.runs import SMALL, build
from tests.conftest import FIXTURES, Capture

DEMO = FIXTURES / "demo.ply"


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process and blocks so small that little scenes do not fit into the memory that is given."""
    monkeypatch.setattr(estimate, "PROCESS", 0)
    monkeypatch.setattr(estimate, "PICTURES", 0)
    monkeypatch.setattr(estimate, "WINDOW", 0)
    monkeypatch.setattr(estimate, "FAMILIES", 0)
    monkeypatch.setattr(estimate, "LEAST_BLOCK_SPLATS", 1 << 12)


@pytest.mark.parametrize("suffix", [".spz", ".rad"])
@pytest.mark.usefixtures("small_blocks")
def test_what_does_not_fit_goes_out_of_core_and_gives_the_same_bytes(
    tmp_path: Path, suffix: str, capsys: Capture
) -> None:
    whole, pieces, scratch = (tmp_path / name for name in (f"a{suffix}", f"b{suffix}", "scratch"))
    assert build(DEMO, "-o", whole, "--json", "--up", "-y") == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["blocks"], record["scratch_bytes_written"], record["scratch_bytes_read"]) == (None, None, None)
    options = ("--up", "-y", "--memory", "3.2M", "--scratch-dir", scratch, "--json", "-v")
    assert build(DEMO, "-o", pieces, *options) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["blocks"] > 1
    assert record["scratch_bytes_written"] > pieces.stat().st_size
    assert record["scratch_bytes_read"] > 0
    assert set(record["seconds"]) >= {"read", "build", "order", "write"}
    assert re.search(
        r"demo\.ply: goes out of core, as it would take about .* MB of memory and --memory gives it 3\.2 MB;"
        r" 27,800 splats in blocks of up to 8,192, scratch of about .* MB in .*scratch",
        err,
    )
    assert re.search(rf"out of core in {record['blocks']} blocks; scratch: .* MB written, .* MB read", err)
    assert whole.read_bytes() == pieces.read_bytes()
    assert read_scene(pieces).up == "y"
    assert not scratch.exists()


@pytest.mark.usefixtures("small_blocks")
def test_the_default_memory_is_a_share_of_what_is_available(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr("sparklod_cli.system.machine.available_memory", lambda: 4_000_000)
    assert build(DEMO, "-o", tmp_path / "a.spz") == 0
    assert "of memory and may take 3.0 MB" in capsys.readouterr().err
    monkeypatch.setattr("sparklod_cli.system.machine.available_memory", lambda: None)
    assert build(DEMO, "-o", tmp_path / "b.spz") == 0
    assert "out of core" not in capsys.readouterr().err


def test_too_little_memory_is_an_error_that_says_how_much_is_enough(tmp_path: Path, capsys: Capture) -> None:
    assert build(DEMO, "-o", tmp_path / "a.spz", "--memory", "20M") == 1
    words = r"20.0 MB of memory is too little even out of core; give --memory (.*) or more"
    found = re.search(words, capsys.readouterr().err)
    assert found is not None
    assert build(DEMO, "-o", tmp_path / "a.spz", "--memory", found[1]) == 0
    assert list(tmp_path.iterdir()) == [tmp_path / "a.spz"]


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(
    ("output", "options", "why"),
    [
        ("a.spz", ["--refine", "1"], "--refine fits a whole tree"),
        ("web/lod-meta.json", [], "detail levels are made of a whole tree"),
        ("web/tileset.json", [], "tiles are made of a whole tree"),
    ],
)
def test_what_needs_a_whole_tree_is_refused_with_the_memory_that_is_enough(
    output: str, options: list[str], why: str, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "web").mkdir()
    assert build(DEMO, "-o", tmp_path / output, *options, "--memory", "3M") == 1
    error = capsys.readouterr().err
    assert f"{DEMO.name}: {why}, not in blocks: " in error
    found = re.search(r"3\.0 MB are enough for [1-9][\d,]+; give --memory (.*) or more if the machine has it", error)
    assert found is not None
    assert build(DEMO, "-o", tmp_path / output, *options, "--memory", found[1]) == 0


@pytest.mark.usefixtures("small_blocks")
def test_a_tree_is_read_as_a_whole(tmp_path: Path) -> None:
    assert build(FIXTURES / "golden" / "tree-v3.spz", "-o", tmp_path / "a.rad", "--memory", "1k") == 0


@pytest.mark.usefixtures("small_blocks")
def test_standard_input_is_baked_out_of_core(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    assert build(DEMO, "-o", tmp_path / "a.spz", "-q") == 0
    with DEMO.open("rb") as file:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(file))
        assert build("-", "-o", "-", "--memory", "3M", "--scratch-dir", tmp_path / "scratch") == 0
    out, err = capsysbinary.readouterr()
    assert b"standard input: goes out of core" in err
    assert out == (tmp_path / "a.spz").read_bytes()
    assert not (tmp_path / "scratch").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--memory", "much"], "'much' is not a size"),
        (["--memory", "0B"], "'0B' must be positive"),
        (["--memory", "4"], "'4' has no unit; write 4G or 4MB"),
        (["--memory", "600000000"], "'600000000' has no unit"),
        (["-o", "-", "--skip-existing"], "--skip-existing needs an output that can be there already"),
        (["--scratch-dir", "-"], "it cannot go to standard output"),
    ],
)
def test_contradictions_are_wrong_usage(arguments: list[str], words: str, tmp_path: Path, capsys: Capture) -> None:
    assert build(DEMO, *([] if "-o" in arguments else ["--output-dir", tmp_path]), *arguments) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_resume_without_a_bake_to_go_on_with_begins(tmp_path: Path, capsys: Capture) -> None:
    assert build(DEMO, "--output-dir", tmp_path, "--resume") == 0
    assert "goes on" not in capsys.readouterr().err


def test_scenes_that_are_there_are_skipped(tmp_path: Path, capsys: Capture) -> None:
    scenes = [tmp_path / f"{name}.ply" for name in "ab"]
    for path in scenes:
        path.write_bytes((FIXTURES / "sh2.ply").read_bytes())
    line = [*scenes, "--output-dir", tmp_path / "web", "--skip-existing", "--json", "-f"]
    assert build(*line) == 0
    assert [json.loads(text).get("skipped") for text in capsys.readouterr().out.splitlines()] == [None, None]
    scenes[1].write_bytes((FIXTURES / "sh3.ply").read_bytes())
    assert build(*line) == 0
    out, err = capsys.readouterr()
    first, second = map(json.loads, out.splitlines())
    assert first == {
        "schema_version": 1,
        "input": str(scenes[0]),
        "output": str(tmp_path / "web" / "a-lod.spz"),
        "skipped": True,
    }
    assert second["sh_degree"] == 3
    assert f"{scenes[0]}  ->  {tmp_path / 'web' / 'a-lod.spz'}  exists already" in err
    assert not list(tmp_path.rglob(f"*{SUFFIX}"))


def test_a_value_of_skip_existing_follows_after_an_equals_sign_only(tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "a.spz"
    assert build("--skip-existing", SMALL, "-o", target) == 0
    first = target.stat().st_mtime_ns
    for option in ("--skip-existing", "--skip-existing=verify"):
        assert build(option, "-o", target, "--", SMALL) == 0
        assert target.stat().st_mtime_ns == first
    assert build("--skip-existing=dates", SMALL, "-o", target) == 2
    assert "'dates' is not one of 'date', 'verify'" in capsys.readouterr().err
