"""Laws about what sparklod makes of any input: scenes, reports and files."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from sparklod_cli.commands.inspect import finding_line
from sparklod_cli.inspection import report
from sparklod_cli.io.reading import open_reader, read_parts, read_scene
from sparklod_cli.model.instances import DetailScene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import Selection
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError, HasTreeError, InvalidSplatsError

from .case import LawError
from .oracle import stderr_fault


def check_scene(scene: Scene) -> None:
    """Checks that a scene can be drawn once invalid splats are dropped; `Splats` itself checks shapes and types."""
    if scene.tree is not None:
        scene.tree.validate()
        if len(scene.tree) != len(scene.splats):
            raise LawError(f"the tree has {len(scene.tree):,} nodes, but there are {len(scene.splats):,} splats")
    try:
        kept, _ = Selection(drop_invalid=True).apply(scene.splats)
    except InvalidSplatsError:
        return
    for column in COLUMNS:
        if not np.isfinite(getattr(kept, column)).all():
            raise LawError(f"{column} has values that are not finite after --on-invalid drop")
    if not (kept.scale >= 0).all():
        raise LawError("negative scales are left after --on-invalid drop")
    if not (kept.opacity >= 0).all():
        raise LawError("negative opacities are left after --on-invalid drop")


def check_stream(path: Path, threads: int) -> None:
    """Checks that a stream fails with the words of the reader of the whole file, or gives the same splats."""
    whole = _outcome(lambda: read_scene(path, threads=threads).splats)
    found = _outcome(lambda: _streamed(path, threads))
    if found is None:
        return
    if isinstance(whole, str) or isinstance(found, str):
        if whole != found:
            raise LawError(f"as a stream: {found!r:.200}; as a whole: {whole!r:.200}", "stream")
    elif any(getattr(whole, name).tobytes() != getattr(found, name).tobytes() for name in COLUMNS):
        raise LawError("a stream gives other splats than the reader of the whole file", "stream")


def check_levels(path: Path, threads: int) -> None:
    """Checks that the detail levels of a scene can be drawn, or are refused; a file of another format is."""
    try:
        scene = read_parts(path, threads=threads)
    except FormatError:
        return
    if not isinstance(scene, DetailScene):
        return
    check_scene(scene.scene())
    if not np.isfinite(scene.bounds).all():
        raise LawError("a bound of a region is not finite", "bound")
    below = np.sort(scene.children, axis=None)
    expected = [*range(-scene.regions, 0), *range(1, scene.regions - 1)] if scene.regions > 1 else []
    if below.tolist() != expected:
        raise LawError(f"children are {scene.children.tolist()!r:.100}", "children")


def _streamed(path: Path, threads: int) -> Splats:
    with open_reader(path, threads=threads) as reader:
        return Splats.concat([Splats.empty(0, reader.sh_degree), *reader.blocks()])


def _outcome(make: Callable[[], Splats]) -> Splats | str | None:
    """The splats, or what is wrong; None for a tree, which has no stream."""
    try:
        return make()
    except HasTreeError:
        return None
    except FormatError as error:
        return str(error)


def check_report(path: Path) -> None:
    """Checks that any file has a report, which is valid JSON and whose findings are printable lines."""
    found, _ = report.inspect(path, report.ReportSettings(True, True, True), threads=2)
    try:
        json.dumps(found.as_dict(), allow_nan=False)
    except ValueError as error:
        raise LawError(f"the report is not JSON: {error}") from None
    for finding in found.findings or []:
        fault, text = stderr_fault(finding_line(str(path), finding, "text"))
        if fault:
            raise LawError(f"of a finding, {text}", f"{fault}, of {finding.code}")


def check_passes(path: Path) -> None:
    """Checks that a file which we wrote breaks no promise that our own check knows."""
    found, _ = report.inspect(path, report.ReportSettings(check=True), threads=2)
    errors = [each for each in found.findings or [] if each.severity == "error"]
    if errors:
        lines = "\n".join(finding_line(str(path.name), each, "text") for each in errors)
        raise LawError(f"our own check rejects what we wrote: {lines}", f"own check: {errors[0].code}")


def check_output(path: Path) -> None:
    """Checks that a file which a command wrote is a whole file of the kind that its suffix names."""
    data = path.read_bytes()
    try:
        if path.suffix in (".spz", ".ply", ".splat"):
            check_scene(read_scene(path))
        elif path.suffix in (".png", ".webp", ".gif"):
            Image.open(io.BytesIO(data)).load()
        elif path.suffix in (".npy", ".npz"):
            arrays = np.load(io.BytesIO(data))
            for array in arrays.values() if path.suffix == ".npz" else [arrays]:
                array.sum()  # reads all of it
        elif path.suffix == ".json":
            json.loads(data)
        elif path.suffix == ".html" and not data.rstrip().endswith(b"</html>"):
            raise LawError("the page ends early")
        elif path.suffix == ".csv" and not data.endswith(b"\n"):
            raise LawError("the table ends in the middle of a line")
    except (FormatError, OSError, ValueError, EOFError) as error:
        raise LawError(f"an output is not a whole file: {path.name!r:.60}: {error}", f"output {path.suffix}") from None
