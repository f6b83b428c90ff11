"""Outputs: tried before any work, never an input, named after inputs in a folder, replaced only with --overwrite."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest

from sparklod_cli.cli import COMMANDS
from sparklod_cli.cli import cli as program
from sparklod_cli.commands.outputs import NamedPath
from sparklod_cli.system.errors import OutputError
from sparklod_cli.system.output import check_writable, try_place
from tests.commands.cli import NAMED, Cli
from tests.conftest import IS_ROOT

PLAIN, LOD = "one.ply", "tree-v3.spz"
LOOK = "--look-at 0,-1,4:0,0,0"

VIEWS = {
    "files": f"X {LOOK}",
    "scene": f"--scene X {LOOK}",
    "camera_path": f"{LOD} --camera-path X",
    "world_transform": f"{LOD} {LOOK} --world-transform X",
}

#: Command lines that read the file X, by the parameter that names it.
INPUTS = {
    "build-lod": {
        "inputs": "X",
        "rgba": f"{PLAIN} --rgba X",
        "scene": "--scene X",
        "environment": f"{PLAIN} --environment X",
        "camera_path": f"{PLAIN} --refine --camera-path X",
    },
    "convert": {"source": "X", "rgba": f"{PLAIN} --rgba X"},
    "simplify": {
        "inputs": "X --to 50%",
        "rgba": f"{PLAIN} --to 50% --rgba X",
        "camera_path": f"{PLAIN} --psnr 30 --camera-path X",
    },
    "inspect": {"files": "X", "expect": f"{LOD} --expect X", "leaves_of": f"{LOD} --leaves-of X"},
    "traverse": VIEWS,
    "render": VIEWS | {"diff": f"{LOD} {LOOK} --diff X"},
    "view": {"files": "X", "camera_path": f"{LOD} --camera-path X", "spark_dir": f"{LOD} --spark-dir X"},
}

#: Options that name the output file Y, by parameter.
OUTPUTS = {
    "build-lod": {"output": "-o Y"},
    "convert": {"output": "Y"},
    "simplify": {"output": "-o Y"},
    "inspect": {"plot": "--plot Y", "html": "--html Y", "chunks_out": "--chunks-out Y"},
    "traverse": {"output": "-o Y", "plot": "--plot Y"},
    "render": {"output": "-o Y", "plot": "--compare --plot Y"},
    "view": {},
}

#: Options with which a command writes the file Y into a folder, and the name that the file gets there.
FOLDERS = {
    "build-lod": {"output": (PLAIN, "one-lod.spz")},
    "convert": {"output": (f"{PLAIN} --format sog", "one.sog")},
    "simplify": {"output": (f"{PLAIN} --to 50%", "one-small.spz")},
    "inspect": {"plot": (LOD, "tree-v3.png"), "html": (LOD, "tree-v3.html"), "chunks_out": (LOD, "tree-v3.csv")},
    "traverse": {"output": (f"{LOD} {LOOK}", "tree-v3.csv"), "plot": (f"{LOD} {LOOK}", "tree-v3.png")},
    "render": dict.fromkeys(("output", "plot"), (f"{LOD} {LOOK} --size 64x64", "tree-v3.png")),
}

#: Command lines that write at P; X is an input that cannot be read, which shows when it is.
PLACES = {
    "build-lod": [
        *("X -o P/a.spz", "X -o P/a.rad", "X -o P/new/a.rad --format rad-chunked", "X -o P/lod-meta.json"),
        *("X -o P/new/tileset.json", "X -o P/a.spz --refine 3", "X -o P/a.rad --memory 4M", "X X -o P/a.spz --merge"),
        *("X -o P/a.spz --skip-existing", "X -o P/a.spz --skip-existing=verify --overwrite"),
        *("X --output-dir P", "X --output-dir P --format streamed-sog"),
    ],
    "convert": [
        *("X P/a.ply", "X P/a.spz", "X P/meta.json", "X P/a.npz --layout packed", "X P/a.rad --format rad-chunked"),
    ],
    "simplify": [
        *("X --to 50% -o P/a.spz", "X --psnr 40 -o P/a.ply", "X --max-bytes 1kB -o P/meta.json"),
        "X --to 50% --refine 3 -o P/a.rad",
    ],
    "render": [
        *("X -o P/a.png", "X -o P/new/a.npy", "X --orbit 3 -o P/a.%d.png", "X --orbit 3 -o P/", "X --dolly -o P/a.gif"),
        *("X --orbit 3 -o P/a.mp4", "X --orbit 3 --sheet -o P/a.png", "X --dolly 2:1 -o P/a.webp"),
        *("X --diff X -o P/a.png", "X --thumbnail -o P/a.png --json", "X --compare -o P/a.csv"),
        *("X --compare -o P/a.parquet", "X --compare --plot P/a.png"),
    ],
    "traverse": [
        *("X -o P/a.csv", "X -o P/a.json --summary", "X -o P/a.parquet", "X --plot P/a.png", "X --indices-out P"),
        *("X --indices-out P/new", "X --json -o P/a.csv"),
    ],
    "inspect": [
        *("X --html P/a.html", "X X --html P/a.html", "X --plot P/a.png", "X --chunks-out P/a.csv"),
        *("X --chunks-out P/a.json --check", "X --leaves-of X --html P/a.html"),
    ],
    "view": ["X --export P/a", "X --export P/new/a --overwrite"],
}

SUFFIXES = {"inspect": ".png", "traverse": ".csv", "render": ".png"}
KEPT_APART = [
    (command, given, written)
    for command in INPUTS
    for given, written in itertools.product(INPUTS[command], OUTPUTS[command])
    if (given, written) != ("diff", "plot")  # --diff does not go with --compare
]
IN_FOLDERS = [(command, name) for command, rows in FOLDERS.items() for name in rows]
TRIED = [(command, way) for command, ways in PLACES.items() for way in ways]


def filled(line: str, **names: object) -> list[str]:
    """Return the words of a line with names for X and Y."""
    return [str(names.get(word, word)) for word in line.split()]


def content(parameter: str) -> bytes:
    """Something that can be read as the file of a parameter."""
    return {
        "expect": b"{}",
        "scene": json.dumps({"instances": [{"file": str(NAMED[LOD])}]}).encode(),
        "camera_path": b"x,y,z,target_x,target_y,target_z\n0,0,-3,0,0,0\n",
        "world_transform": ",".join(map(str, np.eye(4).ravel())).encode(),
        "rgba": bytes(4),
    }.get(parameter, NAMED[LOD].read_bytes())


@pytest.mark.parametrize("name", COMMANDS)
def test_the_tables_have_all_parameters_that_are_files(name: str) -> None:
    command = program.get_command(click.Context(program), name)
    assert command is not None
    for parameter in command.params:
        if not isinstance(parameter.type, NamedPath):
            assert not isinstance(parameter.type, click.Path), parameter.name
        elif not (parameter.type.output and parameter.type.folder):
            assert parameter.name in (OUTPUTS if parameter.type.output else INPUTS)[name]
    if name in OUTPUTS:
        assert OUTPUTS[name].keys() == FOLDERS.get(name, {}).keys()
        flags = (word for options in OUTPUTS[name].values() for word in options.split() if word != "Y")
        assert all(any(flag in way for way in PLACES[name]) for flag in flags)


# --- Outputs and inputs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["itself", "symbolic", "hard"])
@pytest.mark.parametrize(("command", "given", "written"), KEPT_APART)
def test_an_output_that_is_an_input_is_refused(command: str, given: str, written: str, way: str, cli: Cli) -> None:
    before = content(given)
    source = cli.put(f"x{SUFFIXES.get(command, '.spz')}", before)
    target = source if way == "itself" else source.with_stem("y")
    if way == "symbolic":
        target.symlink_to(source)
    elif way == "hard":
        os.link(source, target)
    words = [*filled(INPUTS[command][given], X=source), *filled(OUTPUTS[command][written], Y=target)]
    assert f"{target} is an input; name another output" in cli(command, *words, "--overwrite", status=2).err
    assert source.read_bytes() == target.read_bytes() == before


@pytest.mark.parametrize(
    ("names", "line", "said"),
    [
        # Files that belong to an input: images of an unpacked SOG, chunks, files of a camera path, instances.
        *(
            ("meta.json", f"{command} -f", f"{output} is an input")
            for source in ("./", "meta.json")
            for command, output in (
                *((f"build-lod {source} -o {name}", name) for name in ("a.spz", "b.spz", "c.spz")),
                (f"inspect {source} --html meta.json", "meta.json"),
            )
        ),
        *(
            (
                "images.txt cameras.txt",
                f"traverse {LOD} --camera-path {source} -o cameras.txt --format csv -f",
                "cameras.txt",
            )
            for source in ("./", "images.txt")
        ),
        ("scene.json tree.csv", f"traverse --scene scene.json {LOOK} -o tree.csv -f", "tree.csv is an input"),
        ("scene.json tree.csv", f"traverse --scene scene.json {LOOK} -o scene.json -f", "scene.json is an input"),
        ("scene.json tree.csv", "build-lod --scene scene.json -o tree.csv --format spz -f", "tree.csv is an input"),
        ("tree.csv", f"traverse tree.csv {LOOK} -o ./", "tree.csv is an input"),
        # Names of several outputs.
        ("out.0000.png", f"render out.0000.png {LOOK} -o out.%04d.png -f", "out.0000.png is an input"),
        ("0001.png", f"render {LOD} --camera-path 0001.png -o %04d.png -f", "0001.png is an input"),
        ("000000.npy", f"traverse 000000.npy {LOOK} -o /dev/null --format csv --indices-out ./ -f", "000000.npy is an"),
        ("a.ply a-lod.spz", "build-lod a-lod.spz a.ply -f", "a-lod.spz is an input"),
        ("a.ply a-lod.spz", "build-lod a-lod.spz a.ply --output-dir ./ -f", "a-lod.spz is an input"),
        ("", f"inspect {LOD} --plot y.png --html y.png", "two outputs would be written to y.png"),
    ],
)
def test_files_of_an_input_are_inputs(names: str, line: str, said: str, cli: Cli) -> None:
    special = {
        "meta.json": '{"version": 2, "count": 1, "means": {"files": ["a.spz", "b.spz"]}, "sh0": {"files": ["c.spz"]}}',
        "scene.json": '{"instances": [{"file": "tree.csv"}]}',
        "0001.png": NAMED["sparklod.json"].read_bytes(),
    }
    if "meta.json" in names:
        names += " a.spz b.spz c.spz"
    before = {name: cli.put(name, special.get(name, content("files"))).read_bytes() for name in names.split()}
    assert said in cli(line, status=2).err
    assert {name: (cli.folder / name).read_bytes() for name in before} == before


@pytest.mark.parametrize("source", [".", "lod-meta.json", "0_0", "0_0/meta.json"])
def test_an_output_in_several_files_does_not_replace_its_input(source: str, cli: Cli) -> None:
    cli("build-lod sh1.ply -o lod-meta.json")
    before = {name: (cli.folder / name).read_bytes() for name in cli.made()}
    assert "is an input; name another output" in cli(f"build-lod {source} -o lod-meta.json -f", status=2).err
    assert {name: (cli.folder / name).read_bytes() for name in cli.made()} == before


def test_chunks_of_a_renamed_rad_are_inputs(cli: Cli) -> None:
    cli("build-lod one.ply --format rad-chunked -o a.rad")
    (cli.folder / "a.rad").rename(cli.folder / "b.rad")  # it still names a-0.radc
    said = cli("convert b.rad a.rad --leaves --format rad-chunked -f", status=2).err
    assert "a-0.radc is an input; name another output" in said


def test_names_that_differ_in_case_are_one_file_where_case_is_ignored(cli: Cli) -> None:
    folder = cli.folder / "Web"
    folder.mkdir()
    line = f"inspect missing.spz --plot {folder}/Out.png --html {folder}/out.png"
    if not folder.with_name("wEB").exists():
        folder.with_name("wEB").symlink_to(folder)  # as a file system that ignores case shows it
    assert "two outputs would be written to" in cli(line, status=2).err


#: Parameters that take addresses, which test_addresses.py has.
TAKE_ADDRESSES = {
    *(("build-lod", name) for name in ("inputs", "output", "output_dir")),
    *(("convert", name) for name in ("source", "output")),
    *(("simplify", name) for name in ("inputs", "output")),
}


@pytest.mark.parametrize("name", ["", "s3://bucket/x.spz", "https://example.org/x.spz"])
@pytest.mark.parametrize(("command", "given", "written"), KEPT_APART)
def test_names_that_cannot_be_paths_are_refused(command: str, given: str, written: str, name: str, cli: Cli) -> None:
    said = "is an address on a network, not a path" if name else "the name is empty"
    for x, y in ((PLAIN, name), (name, "out.png")):
        if given == "world_transform" and x == name:
            continue
        if name and (command, given if x == name else written) in TAKE_ADDRESSES:
            continue
        words = [*filled(INPUTS[command][given], X=x), *filled(OUTPUTS[command][written], Y=y)]
        err = cli(command, *words, status=2).err
        assert said in err and name in err


# --- Folders, and files that exist ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "name", "folder"),
    [
        *((command, "output", folder) for command in ("build-lod", "render") for folder in ("there", "there/.")),
        *((command, name, "new/deep/") for command, name in IN_FOLDERS),
    ],
)
def test_a_folder_gets_a_file_named_after_the_input(command: str, name: str, folder: str, cli: Cli) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("pyvista")
    (cli.folder / "there").mkdir()
    line, expected = FOLDERS[command][name]
    cli(f"{command} {line}", *filled(OUTPUTS[command][name], Y=folder))
    assert [path.name for path in Path(folder).iterdir()] == [expected]


@pytest.mark.parametrize(("command", "name"), [row for row in IN_FOLDERS if row[0] != "convert"])
def test_a_name_without_suffix_is_refused_with_a_hint(command: str, name: str, cli: Cli) -> None:
    line, _ = FOLDERS[command][name]
    err = cli(f"{command} {line}", *filled(OUTPUTS[command][name], Y="noname"), status=2).err
    flag = f"--{name.replace('_', '-')}"
    assert f"error: {flag} noname has no suffix, which chooses the format; end it in ." in err
    assert err.endswith(", or in / for a folder\n")
    assert cli.made() == []


def test_inputs_name_the_files_of_a_folder_and_formats_their_suffixes(cli: Cli) -> None:
    for line, made in (
        (f"build-lod {PLAIN} sh0.ply -o out/", "out/one-lod.spz out/sh0-lod.spz"),
        (f"build-lod {PLAIN} -o out/ --format streamed-sog", "out/one-lod/lod-meta.json"),
        (f"build-lod {PLAIN} -o a --format rad", "a"),
        (f"traverse {LOD} {LOOK} -o b --format json", "b"),
        (f"render {LOD} --orbit 2 --size 8x8 -o ./", "tree-v3.0000.png tree-v3.0001.png"),
        (f"render {LOD} --compare {LOOK} --size 64x64 --budget 5% -o ./", "tree-v3.csv"),
        (f"traverse {LOD} {LOOK} -o ./ --format json", "tree-v3.json"),
        ("convert sh1.ply ./ --format sog", "sh1.sog"),
        ("convert sh1-sog/meta.json ./ --format ply", "sh1-sog.ply"),  # named after its folder
        ("build-lod tree-v3.spz --format rad", "tree-v3-lod.rad"),
        ("build-lod sh1.ply --format streamed-sog", "sh1-lod/lod-meta.json"),
    ):
        cli(line)
        assert {*made.split()} <= {*cli.made()}, line
    assert (cli.folder / "a").read_bytes()[:4] == b"RAD0"
    assert (cli.folder / "b").read_bytes()[:1] == b"{"


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("build-lod one.ply", "one-lod.spz"),
        ("build-lod one.ply -o lod-meta.json", "lod-meta.json"),
        ("build-lod one.ply --format rad-chunked -o a.rad", "a.rad"),
        ("build-lod one.ply --format rad-chunked -o a.rad", "a-0.radc"),
        ("build-lod sh1.ply --format streamed-sog", "sh1-lod/lod-meta.json"),
        ("build-lod sh1.ply -o tileset.json", "tileset.json"),
        ("convert sh1.ply a.sog", "a.sog"),
        ("convert sh1.ply web/meta.json", "web/sh0.webp"),
        ("simplify sh1.ply --to 50% -o a.ply", "a.ply"),
        (f"traverse {LOD} {LOOK} -o a.csv", "a.csv"),
        (f"traverse {LOD} --orbit 3 --indices-out cuts -o a.csv", "cuts/000002.npy"),
        (f"render {LOD} --size 8x8", "tree-v3.png"),
        (f"render {LOD} --size 8x8 --orbit 3 -o out.%04d.png", "out.0002.png"),
        (f"inspect {LOD} --html a.html", "a.html"),
    ],
)
def test_a_file_is_replaced_only_with_overwrite(line: str, name: str, cli: Cli) -> None:
    path = cli.folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"precious")
    err = cli(line, status=1).err
    assert f"{name} exists, add --overwrite to replace it" in err
    assert cli.made() == [name] and path.read_bytes() == b"precious"
    cli(f"{line} --overwrite -q")
    assert path.read_bytes() != b"precious"


# --- Places that are tried before the work ----------------------------------------------------------------------------


def attempt(cli: Cli, command: str, way: str, place: Path) -> str:
    """Return the error of a command about a place where nothing can be written; it has read and written nothing."""
    source = cli.put("x.ply", "no splats, which a command that reads it would say\n")
    words = [word.replace("P", os.fspath(place), 1) if "P" in word else word for word in filled(way, X=source)]
    before = sorted(cli.folder.rglob("*"))
    done = cli(command, *words, status=1)
    assert sorted(cli.folder.rglob("*")) == before
    (line,) = done.err.splitlines()
    assert re.match(rf"error: (.*: )?cannot write {re.escape(os.fspath(place))}", line), line
    return line


proc = pytest.mark.skipif(not Path("/proc/self").exists(), reason="this system has no folder where nobody can write")


@pytest.mark.parametrize("place", ["below a file", pytest.param("/proc/sparklod", marks=proc)])
@pytest.mark.parametrize(("command", "way"), TRIED)
def test_no_input_is_read_for_an_output_where_nobody_can_write(command: str, way: str, place: str, cli: Cli) -> None:
    if place != "below a file":
        attempt(cli, command, way, Path(place))
        return
    file = cli.put("file", "")
    assert "a file" in attempt(cli, command, way, file / "folder" if "P" in way.split() else file)


NOBODY = 65_534


@contextlib.contextmanager
def as_another_user() -> Iterator[None]:
    """Root may write everywhere, so it becomes somebody else; other users are that already."""
    if IS_ROOT:
        os.seteuid(NOBODY)
    try:
        yield
    finally:
        if IS_ROOT:
            os.seteuid(0)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that other users may look into, unlike those of pytest."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder)


@proc
@pytest.mark.parametrize(("command", "way"), TRIED)
def test_no_input_is_read_for_an_output_in_a_folder_of_another_user(
    command: str, way: str, open_folder: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(open_folder)
    cli.folder = open_folder
    closed = open_folder / "closed"
    closed.mkdir(0o555)
    attempt(cli, command, way, Path("/proc/sparklod"))  # loads all modules, which others may not read
    (open_folder / "x.ply").chmod(0o666)
    with as_another_user():
        assert "permission denied" in attempt(cli, command, way, closed)


def test_a_trial_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "there.spz").write_bytes(b"former")
    before = [(path.name, path.stat().st_mtime_ns) for path in (tmp_path, tmp_path / "there.spz")]
    check_writable(tmp_path / "new" / "deep" / "a.spz", overwrite=False)
    check_writable(tmp_path / "a.spz", overwrite=False)
    check_writable(tmp_path / "there.spz", overwrite=True)
    try_place(tmp_path / "site")
    assert before == [(path.name, path.stat().st_mtime_ns) for path in (tmp_path, tmp_path / "there.spz")]
    monkeypatch.setattr("sparklod_cli.system.output.UNNAMED", None)  # as on a system without unnamed files
    check_writable(tmp_path / "b.spz", overwrite=False)
    assert [path.name for path in tmp_path.iterdir()] == ["there.spz"]
    if Path("/proc/self").exists():
        with pytest.raises(OutputError, match=r"cannot write /proc/a\.spz"):
            check_writable(Path("/proc/a.spz"), overwrite=False)


def test_a_file_that_is_only_read_may_be_replaced(open_folder: Path) -> None:
    target = open_folder / "a.spz"
    target.touch(0o444)
    open_folder.chmod(0o777)
    if IS_ROOT:
        os.chown(target, NOBODY, NOBODY)
    with as_another_user():
        check_writable(target, overwrite=True)


@pytest.mark.skipif(not IS_ROOT, reason="only root can give files to somebody else")
def test_a_file_of_another_user_in_a_shared_folder_may_not_be_replaced(open_folder: Path) -> None:
    open_folder.chmod(0o1777)
    (open_folder / "a.spz").touch()
    with as_another_user():
        check_writable(open_folder / "b.spz", overwrite=True)
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: operation not permitted"):
            check_writable(open_folder / "a.spz", overwrite=True)


def test_a_file_that_is_marked_as_immutable_may_not_be_replaced(tmp_path: Path) -> None:
    target = tmp_path / "a.spz"
    target.touch()
    marked = shutil.which("chattr") and subprocess.run(["chattr", "+i", target], capture_output=True).returncode == 0
    if not marked:
        pytest.skip("files cannot be marked as immutable here")
    try:
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: operation not permitted"):
            check_writable(target, overwrite=True)
    finally:
        subprocess.run(["chattr", "-i", target], check=True)


def test_a_mount_point_cannot_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as the file or the folder of a container that its host shares with it."""
    (tmp_path / "site").mkdir()
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path).name == "site")
    with pytest.raises(OutputError, match=f"site: {os.strerror(errno.EBUSY).lower()}"):
        try_place(tmp_path / "site")
    try_place(tmp_path / "site" / "inside")


def test_a_full_disk_is_found_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a limit of the file's size, the nearest to a full disk without one, and by the room that is left."""
    resource = pytest.importorskip("resource", reason="this system has no limits of processes")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(OutputError, match=r"cannot write .*a\.spz: file too large"):
            check_writable(tmp_path / "a.spz", overwrite=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not any(tmp_path.iterdir())
    usage = shutil.disk_usage(tmp_path)._replace(free=1_000_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    try_place(tmp_path / "site", least=1_000_000)
    with pytest.raises(OutputError, match=r"site: it takes 2\.0 MB or more, and 1\.0 MB are free there"):
        try_place(tmp_path / "site", least=2_000_000)
