"""No output of a command replaces what it reads, whatever the option and whatever the file is called."""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path

import click
import numpy as np
import pytest

from sparklod_cli.cli import COMMANDS, cli, run
from sparklod_cli.commands.outputs import NamedPath
from tests.conftest import FIXTURES, Capture

PLAIN, LOD = FIXTURES / "one.ply", FIXTURES / "golden" / "tree-v3.spz"
CAMERAS = "x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n"
LOOK = ("--look-at", "0,-1,4:0,0,0")

#: What is asked of each command, by the parameter that gets the input X.
INPUTS: dict[str, dict[str, tuple[object, ...]]] = {
    "build-lod": {
        "inputs": ("X",),
        "rgba": (PLAIN, "--rgba", "X"),
        "scene": ("--scene", "X"),
        "environment": (PLAIN, "--environment", "X"),
        "camera_path": (PLAIN, "--refine", "--camera-path", "X"),
    },
    "convert": {"source": ("X",), "rgba": (PLAIN, "--rgba", "X")},
    "simplify": {
        "inputs": ("X", "--to", "50%"),
        "rgba": (PLAIN, "--to", "50%", "--rgba", "X"),
        "camera_path": (PLAIN, "--psnr", "30", "--camera-path", "X"),
    },
    "inspect": {"files": ("X",), "expect": (LOD, "--expect", "X"), "leaves_of": (LOD, "--leaves-of", "X")},
    "traverse": {
        "files": ("X", *LOOK),
        "scene": ("--scene", "X", *LOOK),
        "camera_path": (LOD, "--camera-path", "X"),
        "world_transform": (LOD, *LOOK, "--world-transform", "X"),
    },
    "render": {
        "files": ("X", *LOOK),
        "scene": ("--scene", "X", *LOOK),
        "camera_path": (LOD, "--camera-path", "X"),
        "world_transform": (LOD, *LOOK, "--world-transform", "X"),
        "diff": (LOD, *LOOK, "--diff", "X"),
    },
    "view": {"files": ("X",), "camera_path": (LOD, "--camera-path", "X"), "spark_dir": (LOD, "--spark-dir", "X")},
}

#: How each command is told to write the file Y, by the parameter that says so.
OUTPUTS: dict[str, dict[str, tuple[str, ...]]] = {
    "build-lod": {"output": ("-o", "Y")},
    "convert": {"output": ("Y",)},
    "simplify": {"output": ("-o", "Y")},
    "inspect": {"plot": ("--plot", "Y"), "html": ("--html", "Y"), "chunks_out": ("--chunks-out", "Y")},
    "traverse": {"output": ("-o", "Y"), "plot": ("--plot", "Y")},
    "render": {"output": ("-o", "Y"), "plot": ("--compare", "--plot", "Y")},
    "view": {},
}

#: Names that the command's outputs can have.
SUFFIXES = {
    "build-lod": ".spz",
    "convert": ".spz",
    "simplify": ".spz",
    "inspect": ".png",
    "traverse": ".csv",
    "render": ".png",
}

ROWS = [
    (command, given, written)
    for command in INPUTS
    for given, written in itertools.product(INPUTS[command], OUTPUTS[command])
    if (given, written) != ("diff", "plot")  # --diff does not go with --compare
]


def content(parameter: str) -> bytes:
    """Something that can be read as what a parameter takes."""
    return {
        "expect": b"{}",
        "scene": json.dumps({"instances": [{"file": str(LOD)}]}).encode(),
        "camera_path": CAMERAS.encode(),
        "world_transform": ",".join(map(str, np.eye(4).ravel())).encode(),
        "rgba": bytes(4),
    }.get(parameter, LOD.read_bytes())


@pytest.mark.parametrize("name", COMMANDS)
def test_the_table_has_all_parameters_that_are_files(name: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    for parameter in command.params:
        if not isinstance(parameter.type, NamedPath):
            assert not isinstance(parameter.type, click.Path), parameter.name
        elif not (parameter.type.output and parameter.type.folder):
            assert parameter.name in (OUTPUTS if parameter.type.output else INPUTS)[name]


@pytest.mark.parametrize("way", ["itself", "symbolic", "hard"])
@pytest.mark.parametrize(("command", "given", "written"), ROWS)
def test_an_output_that_is_an_input_is_refused(
    command: str, given: str, written: str, way: str, tmp_path: Path, capsys: Capture
) -> None:
    source = tmp_path / f"x{SUFFIXES[command]}"
    target = source if way == "itself" else source.with_stem("y")
    before = content(given)
    source.write_bytes(before)
    if way == "symbolic":
        target.symlink_to(source)
    elif way == "hard":
        os.link(source, target)
    arguments = [source if argument == "X" else argument for argument in INPUTS[command][given]]
    arguments += [target if argument == "Y" else argument for argument in OUTPUTS[command][written]]
    assert run([command, *map(str, arguments), "--overwrite"]) == 2
    assert f"{target} is an input; name another output" in capsys.readouterr().err
    assert source.read_bytes() == target.read_bytes() == before


@pytest.mark.parametrize("command", ["inspect", "traverse"])
def test_two_outputs_are_two_files(command: str, tmp_path: Path, capsys: Capture) -> None:
    one, two, *_ = OUTPUTS[command].values()
    target = str(tmp_path / f"y{SUFFIXES[command]}")
    arguments = [target if argument == "Y" else argument for argument in (*one, *two)]
    assert run([command, str(LOD), *arguments]) == 2
    assert f"two outputs would be written to {target}" in capsys.readouterr().err


def test_the_images_of_an_unpacked_sog_are_inputs(tmp_path: Path, capsys: Capture) -> None:
    meta = {"version": 2, "count": 1, "means": {"files": ["a.spz", "b.spz"]}, "sh0": {"files": ["c.spz"]}}
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    for name in ("a", "b", "c", "other"):
        (tmp_path / f"{name}.spz").write_bytes(b"precious")
    for source in (tmp_path, tmp_path / "meta.json"):
        for name in ("a.spz", "b.spz", "c.spz"):
            assert run(["build-lod", str(source), "-o", str(tmp_path / name), "--overwrite"]) == 2
            assert f"{name} is an input" in capsys.readouterr().err
        assert run(["inspect", str(source), "--html", str(tmp_path / "meta.json"), "--overwrite"]) == 2
        assert run(["build-lod", str(source), "-o", str(tmp_path / "other.spz")]) == 1  # exists, and is no input
        assert "other.spz exists" in capsys.readouterr().err
    assert (tmp_path / "a.spz").read_bytes() == b"precious"


def test_the_files_that_belong_to_a_camera_path_are_inputs(tmp_path: Path, capsys: Capture) -> None:
    for name in ("cameras.txt", "images.txt"):
        (tmp_path / name).write_text("precious")
    for source in (tmp_path, tmp_path / "images.txt"):
        given = ["traverse", str(LOD), "--camera-path", str(source), "-o", str(tmp_path / "cameras.txt")]
        assert run([*given, "--format", "csv", "--overwrite"]) == 2
        assert "cameras.txt is an input" in capsys.readouterr().err


def test_files_that_a_scene_names_are_inputs(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "tree.csv").write_bytes(LOD.read_bytes())
    (tmp_path / "scene.json").write_text('{"instances": [{"file": "tree.csv"}]}')
    given = ["traverse", "--scene", str(tmp_path / "scene.json"), *LOOK, "-o", str(tmp_path / "tree.csv")]
    assert run([*given, "--overwrite"]) == 2
    assert "tree.csv is an input" in capsys.readouterr().err


def test_frames_and_indices_do_not_replace_inputs(tmp_path: Path, capsys: Capture) -> None:
    frame, indices = tmp_path / "out.0000.png", tmp_path / "000000.npy"
    for file in (frame, indices):
        file.write_bytes(LOD.read_bytes())
    assert run(["render", str(frame), *LOOK, "-o", str(tmp_path / "out.%04d.png"), "--overwrite"]) == 2
    assert "out.0000.png is an input" in capsys.readouterr().err
    given = ["traverse", str(indices), *LOOK, "-o", os.devnull, "--format", "csv", "--indices-out", str(tmp_path)]
    assert run([*given, "--overwrite"]) == 2
    assert "000000.npy is an input" in capsys.readouterr().err
    assert frame.read_bytes() == indices.read_bytes() == LOD.read_bytes()


def test_a_folder_is_not_filled_with_inputs_replaced(tmp_path: Path, capsys: Capture) -> None:
    plain, other = tmp_path / "a.ply", tmp_path / "a-lod.spz"
    for file in (plain, other):
        file.write_bytes(PLAIN.read_bytes())
    for options in ([], ["--output-dir", str(tmp_path)]):
        assert run(["build-lod", str(other), str(plain), *options, "--overwrite"]) == 2
        assert f"{other} is an input" in capsys.readouterr().err
    assert other.read_bytes() == PLAIN.read_bytes()


def test_names_that_differ_in_case_are_one_file_where_case_is_ignored(tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "Web"
    folder.mkdir()
    large, small = (str(folder / name) for name in ("Out.png", "out.png"))
    given = ["inspect", str(tmp_path / "missing.spz"), "--plot", large, "--html", small]
    is_ignored = folder.with_name("wEB").exists()
    run(given)
    assert ("two outputs" in capsys.readouterr().err) == is_ignored
    if not is_ignored:
        folder.with_name("wEB").symlink_to(folder)  # as a file system that ignores case shows it
        assert run(given) == 2
        assert "two outputs would be written to" in capsys.readouterr().err


def test_devices_are_not_replaced() -> None:
    given = ["inspect", str(LOD), "--html", os.devnull, "--expect", os.devnull]
    assert run([*given, "--overwrite"]) == 1  # for that is no file of expectations


#: Parameters that take addresses; tests/commands/build_lod/test_addresses.py has them.
TAKE_ADDRESSES = {
    *(("build-lod", name) for name in ("inputs", "output", "output_dir")),
    *(("convert", name) for name in ("source", "output")),
    *(("simplify", name) for name in ("inputs", "output")),
}


@pytest.mark.parametrize("name", ["", "s3://bucket/x.spz", "https://example.org/x.spz"])
@pytest.mark.parametrize(("command", "given", "written"), ROWS)
def test_names_that_cannot_be_paths_are_refused(
    command: str, given: str, written: str, name: str, capsys: Capture
) -> None:
    said = "is an address on a network, not a path" if name else "the name is empty"
    for x, y in ((PLAIN, name), (name, "out.png")):
        if given == "world_transform" and x == name:
            continue
        if name and (command, given if x == name else written) in TAKE_ADDRESSES:
            continue
        arguments = [x if argument == "X" else argument for argument in INPUTS[command][given]]
        arguments += [y if argument == "Y" else argument for argument in OUTPUTS[command][written]]
        assert run([command, *map(str, arguments)]) == 2
        err = capsys.readouterr().err
        assert said in err
        assert name in err
