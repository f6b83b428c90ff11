"""The law of options for `sparklod traverse`: what is given is used, or refused by its name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs import spz
from sparklod_cli.commands.traverse import traverse as command
from sparklod_cli.images import charts
from sparklod_cli.lod import quick
from sparklod_cli.lod.tree_settings import TileSettings
from sparklod_cli.model.scene import Scene
from tests.commands.render.test_options import GIVEN as OF_RENDER
from tests.conftest import FIXTURES, Capture
from tests.lod.trees import row_of_regions
from tests.part_files import tiled, write_streamed
from tests.scenes import random_splats

CAMERAS = FIXTURES / "cameras"

#: Trees of a few thousand nodes; each is a chunk.
TREES = ("tree.spz", "second.spz", "third.spz")

#: Options that only this command has, or that take something else here.
OWN: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "files": ((), (str(FIXTURES / "golden" / "hand-tree-v3.spz"),)),
    "scene": ((), ("--scene", "scene.json")),
    "precision": (("--budget", "5k"), ("--precision", "ext")),
    "preset": ((), ("--preset", "quest")),
    "lod_splat_scale": ((), ("--lod-splat-scale", "1e-4")),
    "cone_fov0": (("--budget", "5k"), ("--cone-fov0", "0")),
    "cone_fov": (("--budget", "5k"), ("--cone-fov0", "0", "--cone-fov", "5")),
    "cone_foveate": (("--budget", "5k", "--cone-fov0", "0"), ("--cone-foveate", "0.01")),
    "outside_foveate": (("--budget", "5k"), ("--outside-foveate", "0.01")),
    "behind_foveate": (("--budget", "5k"), ("--behind-foveate", "0.001")),
    "lod_underfill": (("--bandwidth", "100kbit"), ("--lod-underfill", "2")),
    "distance": ((), ("--distance", "2")),
    "chunk_cache": ((), ("--chunk-cache", "2")),
    "bandwidth": ((), ("--bandwidth", "1Mbit")),
    "latency": (("--bandwidth", "1Mbit"), ("--latency", "90ms")),
    "fetchers": (("--bandwidth", "1Mbit", "--latency", "90ms"), ("--fetchers", "1")),
    "output": ((), ("-o", "table.csv")),
    "form": (("-o", "table"), ("--format", "json")),
    "per_instance": ((), ("--per-instance",)),
    "no_timing": ((), ("--no-timing",)),
    "asserts": ((), ("--assert", "churn>1000")),
    "plot": ((), ("--plot", "plot.png")),
    "indices_out": ((), ("--indices-out", "cuts")),
    "padded": (("--indices-out", "cuts"), ("--padded",)),
    "as_json": ((), ("--json",)),
}

#: Options that change how work is done, or what is said, and nothing that comes out.
OF_WORK = {"overwrite", "threads", "quiet", "verbose", "summary"}

MODES: dict[str, tuple[str, ...]] = {
    "an orbit": ("--orbit", "3", "--distance", "1"),
    "a view": ("--look-at", "0.5,-0.5,0.5:3,0,3"),
    "a dolly over a network": ("--dolly", "--every", "20", "--bandwidth", "2Mbit", "--latency", "20ms"),
    "a camera path": ("--camera-path", str(CAMERAS / "inria.json")),
    "keyframes": ("--keyframes", "0.5,-0.5,0.5:3,0,3 -0.5,-0.5,0.5:3,0,-3", "--every", "20"),
    "Streamed SOG": ("--keyframes", "0,0,7:0,0,20 0,0,1:0,0,20", "--every", "10", "--budget", "200"),
    "3D Tiles": ("--orbit", "3", "--distance", "9"),
    "a summary": ("--orbit", "3", "--distance", "2", "--json"),
}

#: What is looked at in place of trees.
IN_RUNS = {"Streamed SOG": ("web",), "3D Tiles": ("city",)}

#: Options that ask for what is so already: nothing is behind cameras that see all.
THE_SAME = {"a dolly over a network": {"behind_foveate"}}

GIVEN = {param.name: (OF_RENDER | OWN)[param.name] for param in command.params if param.name in OF_RENDER | OWN}


def tidy(text: str, *, table: bool) -> Any:
    """What is said, without the times that it took."""
    if text.startswith("{") and not table:
        whole = json.loads(text)
        whole.get("quantities", {}).pop("traverse_ms", None)
        return whole
    lines = [line.split(",") for line in text.splitlines()]
    timed = bool(lines) and lines[0][-1] == "traverse_ms"
    return [line[:-1] if timed and number else line for number, line in enumerate(lines)]


@pytest.fixture(scope="module")
def trees() -> dict[str, bytes]:
    scenes = [Scene(*quick.build(random_splats(4000, seed=seed, extent=1.5))) for seed in range(len(TREES))]
    return {name: b"".join(spz.encode(scene)) for name, scene in zip(TREES, scenes, strict=True)}


@pytest.mark.parametrize("mode", MODES)
def test_every_option_of_traverse_is_used_or_refused(
    mode: str,
    trees: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(charts, "plot", lambda *arguments: (b"a plot", None))  # takes seconds, and has its tests
    for name, data in trees.items():
        (tmp_path / name).write_bytes(data)
    write_streamed(tmp_path / "web", row_of_regions(8, 4), together=8)
    tiled(random_splats(900), tmp_path / "city", TileSettings(tile_splats=200))
    (tmp_path / "scene.json").write_text(json.dumps({"instances": [{"file": "tree.spz", "scale": 3}]}))
    inputs = {path.name for path in tmp_path.iterdir()}
    known: dict[tuple[str, ...], Any] = {}

    def came(*arguments: str) -> Any:
        if arguments not in known:
            files = () if "--scene" in arguments else IN_RUNS.get(mode, TREES)
            code = run(["traverse", *files, *MODES[mode], *arguments])
            out, err = capsys.readouterr()
            written = {}
            for path in sorted(tmp_path.rglob("*")):
                if path.is_file() and not inputs & {path.name, path.relative_to(tmp_path).parts[0]}:
                    table = path.suffix in ("", ".csv")
                    written[path.name] = tidy(path.read_text(), table=True) if table else path.read_bytes()
                    path.unlink()
            known[arguments] = code, written, tidy(out, table=False), err
        return known[arguments]

    assert came()[0] == 0, came()[3]
    ignored = []
    for name, (needs, given) in GIVEN.items():
        if name in THE_SAME.get(mode, ()) or all(part in MODES[mode] for part in given):
            continue
        before, after = came(*needs), came(*needs, *given)
        if after[0] in (1, 2):
            assert "error: " in after[3].lower(), (name, after[3])
        elif after[:3] == before[:3]:
            ignored.append(str(name))
    assert " ".join(ignored) == ""


def test_every_option_of_traverse_has_a_row() -> None:
    assert {param.name for param in command.params} == set(GIVEN) | OF_WORK | {"version", "help_all"}
