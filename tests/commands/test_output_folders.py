"""An output that is a folder gets a file named after the input, and a name without suffix is refused with a hint."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from tests.commands.test_keep_apart import LOD, LOOK, OUTPUTS, PLAIN
from tests.conftest import FIXTURES, Capture

pytestmark = pytest.mark.slow

SMALL = ("--size", "8x8")

#: Options with which each command can write the file Y, by the parameter that names it, and the name of that file.
WRITTEN: dict[str, dict[str, tuple[tuple[object, ...], str]]] = {
    "build-lod": {"output": ((PLAIN,), "one-lod.spz")},
    "convert": {"output": ((PLAIN, "--format", "sog"), "one.sog")},
    "simplify": {"output": ((PLAIN, "--to", "50%"), "one-small.spz")},
    "inspect": {
        "plot": ((LOD,), "tree-v3.png"),
        "html": ((LOD,), "tree-v3.html"),
        "chunks_out": ((LOD,), "tree-v3.csv"),
    },
    "traverse": {"output": ((LOD, *LOOK), "tree-v3.csv"), "plot": ((LOD, *LOOK), "tree-v3.png")},
    "render": {
        "output": ((LOD, *LOOK, *SMALL), "tree-v3.png"),
        "plot": ((LOD, *LOOK, "--size", "64x64"), "tree-v3.png"),
    },
}
ROWS = [(command, name) for command, rows in WRITTEN.items() for name in rows]


def arguments(command: str, name: str, target: object) -> list[str]:
    given, _ = WRITTEN[command][name]
    return [command, *map(str, given), *(str(target) if each == "Y" else each for each in OUTPUTS[command][name])]


def names(folder: Path | str) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


def test_every_output_of_a_command_is_tested() -> None:
    assert {command: [*rows] for command, rows in WRITTEN.items()} == {
        command: [*rows] for command, rows in OUTPUTS.items() if rows
    }


@pytest.mark.parametrize(
    ("command", "name", "folder"),
    [
        *((command, "output", folder) for command in ("build-lod", "render") for folder in ("there", "there/.")),
        *((command, name, "new/deep/") for command, name in ROWS),
    ],
)
def test_a_folder_gets_a_file_named_after_the_input(command: str, name: str, folder: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("pyvista")
    (tmp_path / "there").mkdir()
    target = f"{tmp_path}/{folder}"
    assert run(arguments(command, name, target)) == 0
    assert names(target) == [WRITTEN[command][name][1]]


@pytest.mark.parametrize(("command", "name"), [row for row in ROWS if row[0] != "convert"])  # which has --format here
def test_a_name_without_suffix_is_refused_with_a_hint(command: str, name: str, tmp_path: Path, capsys: Capture) -> None:
    target, flag = tmp_path / "noname", f"--{name.replace('_', '-')}"
    assert run(arguments(command, name, target)) == 2
    err = capsys.readouterr().err
    assert f"error: {flag} {target} has no suffix, which chooses the format; end it in ." in err
    assert err.endswith(", or in / for a folder\n")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "endings"),
    [
        ((), ".spz, .rad, /lod-meta.json, /tileset.json"),
        (("--refine",), ".spz, .rad, /lod-meta.json, /tileset.json"),
    ],
)
def test_the_hint_names_the_formats_that_are_possible(
    options: tuple[str, ...], endings: str, tmp_path: Path, capsys: Capture
) -> None:
    assert run(["build-lod", str(LOD), "-o", f"{tmp_path}/noname", *options]) == 2
    assert f"end it in {endings}, or" in capsys.readouterr().err


def test_a_format_that_is_chosen_needs_no_suffix(tmp_path: Path) -> None:
    assert run(["build-lod", str(PLAIN), "-o", f"{tmp_path}/a", "--format", "rad"]) == 0
    assert run(["traverse", str(LOD), *LOOK, "-o", f"{tmp_path}/b", "--format", "json"]) == 0
    assert (tmp_path / "a").read_bytes()[:4] == b"RAD0"
    assert (tmp_path / "b").read_bytes()[:1] == b"{"


def test_several_inputs_go_to_one_folder(tmp_path: Path, capsys: Capture) -> None:
    out = f"{tmp_path}/out/"
    assert run(["build-lod", str(PLAIN), str(FIXTURES / "sh0.ply"), "-o", out]) == 0
    assert names(out) == ["one-lod.spz", "sh0-lod.spz"]
    assert run(["build-lod", str(PLAIN), "-o", out, "--format", "streamed-sog"]) == 0
    assert (tmp_path / "out" / "one-lod" / "lod-meta.json").is_file()
    capsys.readouterr()
    assert run(["build-lod", str(PLAIN), "-o", out, "--output-dir", out]) == 2
    assert run(["build-lod", str(PLAIN), "-o", out, "--merge"]) == 2
    assert "--merge makes one file of all inputs; name it with --output" in capsys.readouterr().err
    assert run(["build-lod", str(PLAIN), str(LOD), "-o", f"{tmp_path}/two.spz"]) == 2
    assert "add --merge to bake them as one scene, or name a folder" in capsys.readouterr().err


def test_frames_and_tables_go_to_a_folder(tmp_path: Path) -> None:
    render = ["render", str(LOD), "-o", f"{tmp_path}/"]
    assert run([*render, "--orbit", "2", *SMALL]) == 0
    assert run([*render, "--thumbnail"]) == 0
    assert run([*render, "--compare", *LOOK, "--size", "64x64", "--budget", "5%"]) == 0
    assert run(["traverse", str(LOD), *LOOK, "-o", f"{tmp_path}/", "--format", "json"]) == 0
    assert names(tmp_path) == [
        *("tree-v3-thumbnail.png", "tree-v3.0000.png", "tree-v3.0001.png", "tree-v3.csv", "tree-v3.json"),
    ]


def test_what_a_folder_holds_is_not_replaced(tmp_path: Path, capsys: Capture) -> None:
    tree = tmp_path / "tree.csv"
    shutil.copy(LOD, tree)
    given = ["traverse", str(tree), *LOOK, "-o", str(tmp_path)]
    assert run(given) == 2
    assert f"{tree} is an input; name another output" in capsys.readouterr().err
    assert run(["inspect", str(LOD), "--html", f"{tree}/"]) == 1
    assert f"{tree} is a file, not a folder" in capsys.readouterr().err


def test_standard_input_has_no_name(tmp_path: Path, capsys: Capture) -> None:
    for given in (["build-lod", "-", "-o", f"{tmp_path}/"], ["inspect", "-", "--html", str(tmp_path)]):
        assert run(given) == 2
        assert "standard input has no name to derive one from; name the output file" in capsys.readouterr().err
