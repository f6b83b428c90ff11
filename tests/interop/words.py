"""Compares the words of a file in both of Spark's layouts: those of Spark's worker, and sparklod's of what it reads."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sparklod_cli.codecs import ext_splats, packed_splats, spark_nodes
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model import gaussian
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import Splats
from tests.interop import ties
from tests.interop.spark import Spark
from tests.interop.ties import Words, check, ext_codes, ext_steps, packed_codes, packed_steps


def spark_encoding(encoding: SplatEncoding) -> dict[str, Any]:
    """Returns an encoding by Spark's names."""
    return {re.sub("_(.)", lambda match: match[1].upper(), name): value for name, value in asdict(encoding).items()}


def check_file(spark: Spark, path: Path, share: float, encoding: SplatEncoding = DEFAULT) -> None:
    """Compares both layouts and the tree of a file: those of Spark's worker, and ours of the same file.

    Args:
        share: of codes that ties may decide, see `ties`.
        encoding: that Spark's worker is asked for; files with an encoding of their own have that instead.
    """
    scene = read_scene(path)
    encoding = SplatEncoding(**asdict(encoding) | {"lod_opacity": scene.tree is not None})
    check_packed(spark.load_words("Packed", path, encoding=spark_encoding(encoding)), scene, encoding, share)
    check_ext(spark.load_words("Ext", path), scene, share)


def check_packed(theirs: Words, scene: Scene, encoding: SplatEncoding, share: float) -> None:
    """Compares Spark's PackedSplats and tree of a scene with ours."""
    ours = packed_splats.pack(scene.splats, encoding)
    check(packed_codes(ours), packed_codes(theirs), packed_steps(scene.splats, encoding), share)
    assert theirs.keys() - {"lodTree"} == ours.keys()
    for name in ours.keys() - {"packed"}:
        np.testing.assert_array_equal(ours[name], theirs[name])
    if scene.tree:
        held = packed_splats.unpack({"packed": theirs["packed"]}, encoding)
        check_tree(spark_nodes.pack(held, scene.tree)["lod_tree"], theirs["lodTree"], held, share)


def check_ext(theirs: Words, scene: Scene, share: float) -> None:
    """Compares Spark's ExtSplats and tree of a scene with ours."""
    ours = ext_splats.pack(scene.splats)
    np.testing.assert_array_equal(ours["ext0"][:, :3], theirs["ext0"][:, :3])
    check(ext_codes(ours), ext_codes(theirs), ext_steps(scene.splats), share)
    assert theirs.keys() - {"lodTree"} == ours.keys()
    np.testing.assert_array_equal(ext_sh(ours), ext_sh(theirs))
    if scene.tree:
        held = ext_splats.unpack({name: theirs[name] for name in ("ext0", "ext1")})
        check_tree(spark_nodes.pack(held, scene.tree)["lod_tree"], theirs["lodTree"], held, share)


def ext_sh(words: Words) -> NDArray[np.uint32]:
    """Returns the words of SH without unused ones, in which Spark leaves what its buffer had before."""
    names = [name for name in ("sh1", "sh2", "sh3a", "sh3b") if name in words]
    everything = np.concatenate([words["ext0"][:, :0], *(words[name] for name in names)], axis=1)
    return everything[:, : (0, 3, 8, 0, 15)[len(names)]]


def check_tree(ours: NDArray[np.uint32], theirs: NDArray[np.uint32], held: Splats, share: float) -> None:
    one, other = (words.view(spark_nodes.NODE)[:, 0] for words in (ours, theirs))
    for name in ("center", "child_count", "child_start"):
        np.testing.assert_array_equal(one[name], other[name])
    steps, error = ties.half(gaussian.spark_size(held))
    check({"size": one["size"]}, {"size": other["size"]}, {"size": (steps, 4 * error)}, share)
