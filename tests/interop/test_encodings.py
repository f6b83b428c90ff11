"""The in-memory encodings are word for word those of Spark: of its worker for files, of its JavaScript for numbers.

Exceptions are ties that last bits decide (see `ties`); the tests bound their share of all codes by two to three times
the share that was measured.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fixtures import by_hand
from sparklod_cli.codecs import ext_splats, packed_splats, spark_nodes, spz
from sparklod_cli.codecs.options import WriteOptions
from sparklod_cli.codecs.spark_codings import DEFAULT, SplatEncoding
from sparklod_cli.io.reading import read_scene
from sparklod_cli.lod import quick
from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import SH_C0
from sparklod_cli.model.splats import Splats
from tests.conftest import real_scene
from tests.interop.spark import Spark
from tests.interop.ties import Floats, check, ext_codes, ext_steps, packed_codes, packed_steps
from tests.interop.words import check_file, check_tree, spark_encoding
from tests.scenes import random_splats

pytestmark = pytest.mark.slow

WIDE = SplatEncoding(rgb_min=-0.5, rgb_max=2, ln_scale_min=-8, ln_scale_max=1, sh1_max=0.5, sh2_max=2, sh3_max=0.25)
PROGRAM = Path(__file__).with_name("spark_encode.mjs")


# --- The worker -------------------------------------------------------------------------------------------------------


def ply(path: Path, splats: Splats) -> Path:
    with np.errstate(divide="ignore"):
        opacity = splats.opacity.astype(np.float64)
        columns = by_hand.ply_columns(
            center=splats.center,
            log_scale=np.log(splats.scale.astype(np.float64)),
            quat_wxyz=splats.quat_xyzw[:, [3, 0, 1, 2]],
            logit=np.log(opacity) - np.log1p(-opacity),
            dc=(splats.rgb - 0.5) / SH_C0,
            sh=splats.sh,
        )
    path.write_bytes(by_hand.ply({name: np.array(column, np.float32) for name, column in columns.items()}))
    return path


def baked(path: Path, splats: Splats, version: int) -> Path:
    path.write_bytes(b"".join(spz.encode(Scene(*quick.build(splats)), WriteOptions(spz_version=version), threads=2)))
    return path


def edges() -> Splats:
    """Combines every hard rotation with hard values of the other columns, such as the ends of all ranges."""
    half = 0.5**0.5
    quats = [[0, 0, 0, 1], [0, 0, 0, -1], [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]]
    quats += [[0, 0, -1, 0], [half, 0, 0, half], [0, 0, -half, -half], [0, half, -half, 0], [-half, -half, 0, 0]]
    quats += [[0.5, 0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [half, half, 1e-7, 1e-4]]
    quats += [[1e-4, -1e-4, 1e-4, 1], [0, 0, -1e-7, 1], [3e-4, -5e-4, -1e-4, 1]]
    scales = [0, np.exp(-12), np.exp(-11.95), 1e-3, 1, np.exp(9), np.exp(9.2), 1e6]
    opacities = [0, 1e-6, 0.25, 0.5, 0.999999, 1]
    colours = [-3, -0.1, 0, 0.5, 1, 1.1, 2.5]
    count = len(quats) * 56
    rest = np.arange(count)
    splats = random_splats(count, sh_degree=3)
    splats.quat_xyzw[:] = np.repeat(quats, 56, axis=0)
    splats.scale[:] = np.stack([np.take(scales, rest // step, mode="wrap") for step in (1, 3, 8)], axis=1)
    splats.opacity[:] = np.take(opacities, rest, mode="wrap")
    splats.rgb[:] = np.stack([np.take(colours, rest // step, mode="wrap") for step in (1, 2, 7)], axis=1)
    splats.center[:] = np.exp(np.linspace(-25, np.log(7e4), count))[:, None] * [1, -1, 0]
    numbers = np.array([-2, -1, -0.5, -1e-9, 0, 0.125, 0.25, 0.5, 1, 3, 8, 1e5], np.float32)
    numbers = np.concatenate([numbers, np.nextafter(numbers, np.float32(0))])  # below powers of two
    splats.sh[:] = np.random.default_rng(0).choice(numbers, splats.sh.shape)
    return splats


@pytest.mark.parametrize("sh_degree", range(4))
def test_words_of_random_splats_are_those_of_spark(spark: Spark, tmp_path: Path, sh_degree: int) -> None:
    path = ply(tmp_path / "random.ply", random_splats(50_000, sh_degree=sh_degree))
    check_file(spark, path, share=2e-4)


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE])
def test_words_at_the_ends_of_ranges_are_those_of_spark(spark: Spark, tmp_path: Path, encoding: SplatEncoding) -> None:
    """Ties are frequent here, as the numbers are round."""
    check_file(spark, ply(tmp_path / "edges.ply", edges()), 0.2, encoding)


@pytest.mark.parametrize("sh_degree", range(4))
@pytest.mark.parametrize("version", [2, 3])
def test_words_of_a_tree_are_those_of_spark(spark: Spark, tmp_path: Path, version: int, sh_degree: int) -> None:
    """SPZ has few distinct numbers, so the same ties occur again and again."""
    path = baked(tmp_path / "tree.spz", random_splats(20_000, sh_degree=sh_degree), version)
    assert lod_opacity(read_scene(path).splats.opacity).max() > 1.5
    check_file(spark, path, share=2e-3)


@pytest.mark.parametrize("name", ["biker.ply", "playbot-125k.ply"])
def test_words_of_a_real_scene_are_those_of_spark(spark: Spark, name: str) -> None:
    check_file(spark, real_scene(name), share=2e-3)


def test_words_of_a_baked_real_scene_are_those_of_spark(spark: Spark, tmp_path: Path) -> None:
    check_file(spark, baked(tmp_path / "tree.spz", read_scene(real_scene("biker.ply")).splats, 3), share=2e-3)


@pytest.mark.parametrize("layout", ["Packed", "Ext"])
def test_the_tree_of_sparks_own_builder_comes_back(spark: Spark, tmp_path: Path, layout: str) -> None:
    """Unpacking its merged splats and packing them again gives its nodes."""
    path = ply(tmp_path / "random.ply", random_splats(20_000))
    words = spark.load_words(layout, path, lod=True)
    held = (
        packed_splats.unpack(words, SplatEncoding(lod_opacity=True)) if layout == "Packed" else ext_splats.unpack(words)
    )
    nodes = spark_nodes.unpack({"lod_tree": words["lodTree"]})
    nodes.tree.validate()
    check_tree(spark_nodes.pack(held, nodes.tree)["lod_tree"], words["lodTree"], held, share=1e-3)
    # The size of Spark's LoD design, by which its quick builder sorts, is another one.
    design = 2 * held.scale.max(axis=1) * np.maximum(lod_opacity(held.opacity), 1)
    assert (nodes.size != design.astype(np.float16)).mean() > 0.9


def test_sparks_worker_codes_only_a_scale_of_0_as_zero(spark: Spark, tmp_path: Path) -> None:
    """Spark's documentation and its JavaScript make scales below e ** -30 zero, and so does sparklod."""
    splats = random_splats(1)
    splats.scale[:] = [0, np.exp(-31), np.exp(-29)]
    path = ply(tmp_path / "tiny.ply", splats)
    theirs = spark.load_words("Packed", path)["packed"].view(packed_splats.SPLAT)
    ours = packed_splats.pack(read_scene(path).splats)["packed"].view(packed_splats.SPLAT)
    assert theirs["log_scale"].tolist() == [[[0, 1, 1]]]
    assert ours["log_scale"].tolist() == [[[0, 0, 1]]]


# --- The JavaScript ---------------------------------------------------------------------------------------------------


def cut_off(values: Floats) -> NDArray[np.float16]:
    """Rounds to float16 towards zero."""
    nearest = values.astype(np.float16)
    return np.where(np.abs(nearest.astype(np.float64)) > np.abs(values), np.nextafter(nearest, np.float16(0)), nearest)


@pytest.mark.parametrize("encoding", [DEFAULT, WIDE, SplatEncoding(lod_opacity=True)])
def test_words_are_those_of_sparks_encoders_in_javascript(
    spark_dir: Path, tmp_path: Path, encoding: SplatEncoding
) -> None:
    """Spark's JavaScript has float64; in a Node without Float16Array it rounds float16 towards zero."""
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    splats = random_splats(20_000, sh_degree=3, seed=1)
    splats.scale[:100] = np.exp(np.linspace(-40, -20, 300)).reshape(-1, 3)
    numbers = [splats.center, splats.scale, splats.quat_xyzw, splats.opacity[:, None], splats.rgb]
    np.concatenate([*numbers, splats.sh.reshape(len(splats), -1)], axis=1).astype("<f4").tofile(tmp_path / "in")
    command = ["node", str(PROGRAM), str(spark_dir), str(tmp_path / "in"), str(tmp_path / "out")]
    command.append(json.dumps(spark_encoding(encoding)))
    done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    to_half = cut_off if done.stdout.strip() == "cuts" else np.float16

    def words(name: str, width: int, dtype: str = "<u4") -> NDArray[Any]:
        return np.fromfile(tmp_path / f"out.{name}", dtype).reshape(-1, width)

    ours = packed_splats.pack(splats, encoding)
    codes, steps = packed_codes(ours), packed_steps(splats, encoding)
    codes["center"] = to_half(splats.center)
    check(codes, packed_codes({"packed": words("packed", 4)}), steps, share=2e-4)
    for name in ("sh1", "sh2", "sh3"):
        np.testing.assert_array_equal(ours[name], words(name, packed_splats.SH_WORDS[int(name[2])]))

    ext = {name: words(name, 4) for name in ("ext0", "ext1")}
    codes, steps = ext_codes(ext_splats.pack(splats)), ext_steps(splats)
    codes |= {"alpha": to_half(splats.opacity), "rgb": to_half(splats.rgb), "log_scale": to_half(np.log(splats.scale))}
    if to_half is cut_off:  # then ties of float32 logarithms are at whole steps
        value, error = steps["log_scale"]
        steps["log_scale"] = value + 0.5, error
    check(codes, ext_codes(ext), steps, share=2e-4)
    sh = ext_splats.encode_sh(splats.sh) != words("ext-sh", 15)
    assert sh.mean() < 1e-4

    for layout, held in (
        ("packed", packed_splats.unpack({"packed": words("packed", 4)}, encoding)),
        ("ext", ext_splats.unpack(ext)),
    ):
        d = lod_opacity(held.opacity)
        alpha = np.where(d > 1, (d + 3) / 4, d)
        back = np.split(words(f"{layout}-back", 14, "<f4"), [3, 6, 10, 11], axis=1)
        for one, other in zip((held.center, held.scale, held.quat_xyzw, alpha[:, None], held.rgb), back, strict=True):
            np.testing.assert_allclose(one, other, rtol=2e-6, atol=2e-7)
