"""The report on a .npz file of `build-lod --encoding`, as far as its arrays describe a tree."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from ..codecs.gpu import data_texture, ext_splats, lod_tree, packed_splats
from ..codecs.gpu.dump import Arrays
from ..codecs.splat_encoding import SplatEncoding
from ..model.scene import Scene
from ..model.splats import Splats
from ..system.errors import FormatError
from . import tree, value_checks, values
from .findings import Finding

if TYPE_CHECKING:
    from .report import ReportSettings

#: The note on arrays with the nodes of a tree but without their children.
NO_CHILDREN = "its splats are the nodes of a tree, but it has no child indices, so leaves cannot be told apart"


def examine(arrays: Arrays, settings: ReportSettings, *, threads: int = 1) -> tuple[dict[str, Any], Scene | None]:
    """Return the fields of a report on the arrays of one of `codecs.formats.ENCODINGS`, and the splats if complete.

    Args:
        arrays: by name; the names identify the encoding.

    Raises:
        FormatError: the arrays match no encoding, or have wrong shapes.
    """
    if "packed" in arrays:
        # build-lod writes trees, for which Spark stores LoD opacities; the file does not record that.
        splats = packed_splats.unpack(arrays, SplatEncoding(lod_opacity=True), threads=threads)
        return _of_splats("PackedSplats", splats, settings)
    if "ext0" in arrays:
        return _of_splats("ExtSplats", ext_splats.unpack(arrays, threads=threads), settings)
    if "lod_tree" in arrays:
        return _of_tree(arrays, settings), None
    if "texture" in arrays:
        return _of_texture(arrays, settings), None
    raise FormatError(f"its arrays ({', '.join(arrays)}) match no encoding that build-lod writes")


def _of_splats(name: str, splats: Splats, settings: ReportSettings) -> tuple[dict[str, Any], Scene]:
    scene = Scene(splats, format=f"NPZ of {name}")
    opaque = dataclasses.replace(splats, opacity=np.minimum(splats.opacity, np.float32(1)))  # merged splats exceed 1
    return _fields(
        scene.format,
        len(splats),
        NO_CHILDREN,
        settings,
        sh_degree=splats.sh_degree,
        values=values.examine(splats, all_quantities=settings.all_quantities) if settings.values else None,
        findings=value_checks.check(Scene(opaque)) if settings.check else [],
    ), scene


def _of_tree(arrays: Arrays, settings: ReportSettings) -> dict[str, Any]:
    nodes = lod_tree.unpack(arrays)
    count = len(nodes.tree)
    facts: tree.TreeFacts | None = None
    findings: list[Finding] = []
    if count:
        # Opaque balls of the sizes of the nodes, whose scales and opacities are not stored.
        balls = Splats.zeros(count, 0)
        balls.scale[:] = nodes.size[:, None] / 2
        balls.opacity[:] = 1
        facts, findings = tree.examine(balls, nodes.tree, check=settings.check)
        facts = dataclasses.replace(facts, more_than_opaque=None)
    elif settings.check:
        findings = [Finding("values.empty", "there are no splats")]
    note = "it has centres, sizes and children of nodes, but no opacities, colours and shapes"
    return _fields("NPZ of LodTree", count, note, settings, tree=facts, findings=findings)


def _of_texture(arrays: Arrays, settings: ReportSettings) -> dict[str, Any]:
    capacity = data_texture.capacity(arrays)
    used = np.flatnonzero(np.ascontiguousarray(arrays["texture"]).reshape(capacity, 8).any(axis=1))
    note = "it has centres, covariances and colours of nodes, but no opacities above 1, SH and children"
    return _fields("NPZ of a data texture", int(used[-1]) + 1 if len(used) else 0, note, settings)


def _fields(form: str, splats: int, note: str, settings: ReportSettings, **more: Any) -> dict[str, Any]:
    """Return the fields of a report; spherical harmonics and findings are left out unless they are among `more`."""
    fields = {"format": form, "splats": splats, "sh_degree": 0, "antialiased": False, "notes": [note], "findings": []}
    return fields | more | ({} if settings.check else {"findings": None})
