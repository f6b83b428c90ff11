"""`inspect`: what is in a file, what it is like, and what is wrong with it, as one report."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..codecs.spz_layout import KNOWN_FLAGS
from ..io import examine_scene, size_of_input
from ..model.scene import Scene
from ..model.sh import COEFFICIENTS
from ..model.splats import COLUMNS
from ..support.errors import FormatError
from ..support.progress import Progress, silent
from . import tree, values
from .findings import Finding

#: Counts up when a field of the report changes its meaning or goes away; schema.json describes this one.
SCHEMA_VERSION = 1

#: Columns that the facts of a tree are made of.
TREE_COLUMNS = ("scale", "opacity")


@dataclass(frozen=True)
class Wanted:
    """What to look at, beside the header and the tree.

    Attributes:
        values: the numbers of the splats.
        all_quantities: every quantity of them.
        check: what is wrong.
    """

    values: bool = False
    all_quantities: bool = False
    check: bool = False


@dataclass(frozen=True)
class Report:
    """What is in a file. `as_dict` is what `--json` prints, and what `schema.json` describes.

    Attributes:
        file: as it was named.
        bytes: on disk; of an unpacked SOG, of all its files.
        format: for people; None where it could not be read.
        splats: or nodes of the tree.
        sh_degree, antialiased: of the splats.
        header: numbers of the header that belong to the format.
        bytes_per_splat: of the file.
        compression_ratio: of the decoded splats, in 4-byte floats, to the file.
        notes: what the reader left out.
        tree: where the file is a Level-of-Detail tree.
        values: where they were wanted.
        findings: where they were wanted, or the file could not be read.
    """

    file: str
    bytes: int | None
    format: str | None = None
    splats: int | None = None
    sh_degree: int | None = None
    antialiased: bool | None = None
    header: dict[str, int] = dataclasses.field(default_factory=dict)
    bytes_per_splat: float | None = None
    compression_ratio: float | None = None
    notes: list[str] = dataclasses.field(default_factory=list)
    tree: tree.TreeFacts | None = None
    values: values.ValueFacts | None = None
    findings: list[Finding] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as JSON has them."""
        plain = {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(self)
        if self.findings is not None:
            plain["findings"] = [{"severity": found.severity} | dataclasses.asdict(found) for found in self.findings]
        return plain


def inspect(
    path: Path, wanted: Wanted, *, threads: int = 1, progress: Progress = silent
) -> tuple[Report, Scene | None]:
    """Looks at a file; what cannot be read is a finding, not an error. Also gives what was read of the scene."""
    columns = COLUMNS if wanted.values or wanted.check else TREE_COLUMNS
    size = size_of_input(path)
    try:
        scene = examine_scene(path, columns=columns, threads=threads, progress=progress)
    except FormatError as error:
        return Report(str(path), size, findings=[Finding(error.code, str(error))]), None
    splats, count = scene.splats, len(scene.splats)
    size = scene.header.get("bytes", size)
    findings = _container_findings(scene)
    facts = None
    if scene.tree is not None and count:
        facts, found = tree.examine(splats, scene.tree, check=wanted.check, scale_ends=values.scale_ends(scene))
        findings += found
    if wanted.check:
        findings += values.check(scene)
    report = Report(
        file=str(path),
        bytes=size,
        format=scene.format,
        splats=count,
        sh_degree=splats.sh_degree,
        antialiased=scene.antialiased,
        header=dict(scene.header),
        bytes_per_splat=round(size / count, 3) if size and count else None,
        compression_ratio=round(4 * count * (14 + 3 * COEFFICIENTS[splats.sh_degree]) / size, 3) if size else None,
        notes=list(scene.notes),
        tree=facts,
        values=values.examine(splats, all_quantities=wanted.all_quantities) if wanted.values else None,
        findings=findings if wanted.check else None,
    )
    return report, scene


def _container_findings(scene: Scene) -> list[Finding]:
    header = scene.header
    findings = [Finding("container.left-out", note) for note in scene.notes]
    unknown = header.get("flags", 0) & ~KNOWN_FLAGS
    if unknown:
        findings.append(Finding("container.flags", f"the header has flags {unknown:#04x}, which mean nothing"))
    if header.get("reserved", 0):
        findings.append(Finding("container.flags", "reserved bytes of the header are not 0"))
    if header.get("trailing_members"):
        findings.append(Finding("container.members", "a second gzip member follows, which Spark does not read"))
    elif header.get("trailing_bytes"):
        findings.append(Finding("container.trailing", f"{header['trailing_bytes']:,} bytes follow the data"))
    return findings
