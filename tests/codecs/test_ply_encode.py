"""PLY as it is written, read by plyfile: Inria's layout, and numbers that are finite."""

from __future__ import annotations

import io

import numpy as np
import pytest
from plyfile import PlyData

from fixtures import by_hand
from sparklod_cli.codecs import ply
from sparklod_cli.model.lod_tree import LodTree
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.support.errors import FormatError
from tests.scenes import random_splats, splat_columns

SH_C0 = 0.28209479177387814


def encode(splats: Splats, **more: object) -> bytes:
    return b"".join(ply.encode(Scene(splats, **more)))  # type: ignore[arg-type]


def vertices(data: bytes) -> np.ndarray:
    return PlyData.read(io.BytesIO(data))["vertex"].data


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_the_properties_are_in_the_order_of_inrias_trainer(sh_degree: int) -> None:
    splats = random_splats(7, sh_degree=sh_degree)
    data = encode(splats)
    rows = vertices(data)
    assert data.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 7\nproperty float x\n")
    assert rows.dtype == np.dtype([(name, "<f4") for name in splat_columns(1, sh_degree=sh_degree)])
    assert len(rows) == 7
    rest = [[rows[f"f_rest_{index}"][row] for index in range(3 * splats.sh.shape[1])] for row in range(7)]
    np.testing.assert_array_equal(rest, splats.sh.transpose(0, 2, 1).reshape(7, -1))


def test_every_value_is_where_inria_writes_it() -> None:
    splats = random_splats(2)
    splats.center[:] = [[1.5, -2.25, 1e6], [0, 0, 0]]
    splats.scale[:] = [[1, np.e, 1 / np.e]] * 2
    splats.quat_xyzw[:] = [[0, -0.6, 0.8, 0], [0, 0, 0, 1]]
    splats.opacity[:] = [0.5, 0.75]
    splats.rgb[:] = [[0.5, 0.5 + SH_C0, 0.5 - SH_C0]] * 2
    rows = vertices(encode(splats))

    def columns(names: str) -> list[list[float]]:
        return np.stack([rows[name] for name in names.split()], axis=1).tolist()

    assert columns("x y z") == [[1.5, -2.25, 1e6], [0, 0, 0]]
    assert columns("nx ny nz") == [[0, 0, 0]] * 2
    np.testing.assert_allclose(columns("scale_0 scale_1 scale_2"), [[0, 1, -1]] * 2, atol=1e-6)
    np.testing.assert_allclose(columns("rot_0 rot_1 rot_2 rot_3"), [[0, 0, -0.6, 0.8], [1, 0, 0, 0]], atol=1e-7)
    np.testing.assert_allclose(columns("opacity"), [[0], [np.log(3)]], atol=1e-6)
    np.testing.assert_allclose(columns("f_dc_0 f_dc_1 f_dc_2"), [[0, 1, -1]] * 2, atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_scales_and_opacities_of_0_are_written_finite_and_come_back() -> None:
    splats = random_splats(4)
    splats.opacity[:] = [0, 1, 1e-45, np.nextafter(np.float32(1), np.float32(0))]
    splats.scale[:, 1] = [0, 1e-45, 1e38, 1]
    data = encode(splats)
    assert all(np.isfinite(vertices(data)[name]).all() for name in ("opacity", "scale_1"))
    back = ply.decode(io.BytesIO(data)).splats
    np.testing.assert_allclose(back.opacity, splats.opacity, atol=1e-7)
    assert back.opacity[:2].tolist() == [0, 1]
    np.testing.assert_allclose(back.scale[:, 1], splats.scale[:, 1], rtol=1e-4, atol=2e-45)
    assert back.scale[0, 1] == 0


def test_a_file_that_was_read_is_written_the_same() -> None:
    """All that the file has but normals and the lengths of rotations, to float32's precision."""
    given = splat_columns(50, sh_degree=3)
    rows = vertices(encode(ply.decode(io.BytesIO(by_hand.ply(given))).splats))
    for name, values in given.items():
        np.testing.assert_allclose(rows[name], values, rtol=2e-5, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("count", [0, 1, 40_000])
def test_threads_do_not_change_a_byte_of_ply(count: int) -> None:
    scene = Scene(random_splats(max(count, 1), sh_degree=1).take(slice(count)))
    one = b"".join(ply.encode(scene))
    assert b"".join(ply.encode(scene, threads=3)) == one
    back = ply.decode(io.BytesIO(one)).splats
    assert len(back) == count
    for column in COLUMNS:
        np.testing.assert_allclose(getattr(back, column), getattr(scene.splats, column), rtol=1e-5, atol=1e-6)


def test_ply_refuses_to_write_a_tree() -> None:
    tree = LodTree(np.array([1, 0], np.uint16), np.array([1, 0], np.uint32))
    with pytest.raises(FormatError, match="PLY holds no Level-of-Detail tree"):
        encode(random_splats(2), tree=tree)
