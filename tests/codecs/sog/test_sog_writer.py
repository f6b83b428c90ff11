"""SOG as it is written: its meta.json, its archive, the order of splats, hard values, and what it cannot hold."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparklod_cli
from sparklod_cli.codecs.options import SogOptions, WriteOptions
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.codecs.sog import codec as sog
from sparklod_cli.codecs.sog import sog_container, webp
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.conftest import FIXTURES
from tests.scenes import random_splats


def files_of(scene: Scene, **how: Any) -> dict[str, bytes]:
    return dict(sog.encode_files(scene, **how))


def meta_of(scene: Scene, **how: Any) -> dict[str, Any]:
    meta: dict[str, Any] = json.loads(files_of(scene, **how)["meta.json"])
    return meta


def back(scene: Scene, **how: Any) -> Splats:
    """What is read of the files of a scene, in its order."""
    files = files_of(scene, in_order=True, **how)
    return decode_file(sog, io.BytesIO(files["meta.json"]), open_companion=lambda name: io.BytesIO(files[name])).splats


@pytest.mark.parametrize("degree", range(4))
def test_meta_json_has_every_field_of_the_format(degree: int) -> None:
    meta = meta_of(Scene(random_splats(300, sh_degree=degree)))
    assert list(meta)[:4] == ["version", "asset", "count", "antialias"]
    assert (meta["version"], meta["count"], meta["antialias"]) == (2, 300, False)
    assert meta["asset"] == {"generator": f"sparklod {sparklod_cli.__version__}"}
    assert "model" not in meta
    assert meta["means"]["files"] == ["means_l.webp", "means_u.webp"]
    assert [len(meta["means"][end]) for end in ("mins", "maxs")] == [3, 3]
    assert meta["quats"] == {"files": ["quats.webp"]}
    for name in ("scales", "sh0"):
        assert meta[name].keys() == {"codebook", "files"}
        assert len(meta[name]["codebook"]) == 256
        assert meta[name]["files"] == [f"{name}.webp"]
    assert ("shN" in meta) == bool(degree)
    if degree:
        assert (meta["shN"]["count"], meta["shN"]["bands"], len(meta["shN"]["codebook"])) == (300, degree, 256)
        assert meta["shN"]["files"] == ["shN_centroids.webp", "shN_labels.webp"]


@pytest.mark.parametrize("antialiased", [False, True])
def test_whether_a_scene_is_antialiased_is_kept_in_both_spellings(antialiased: bool) -> None:
    scene = Scene(random_splats(5), antialiased=antialiased)
    meta = meta_of(scene)
    assert (meta["antialias"], meta.get("model")) == (antialiased, "antialiased" if antialiased else None)
    for spelling in ("antialias", "model"):
        files = files_of(scene)
        files["meta.json"] = json.dumps({key: value for key, value in meta.items() if key != spelling}).encode()
        read = decode_file(sog, io.BytesIO(files["meta.json"]), open_companion=lambda name: io.BytesIO(files[name]))  # noqa: B023
        assert read.antialiased is antialiased


def test_an_archive_holds_the_files_as_they_are_and_depends_on_no_clock() -> None:
    scene = Scene(random_splats(100, sh_degree=1))
    data = b"".join(sog.encode(scene))
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == files_of(scene)
        assert archive.namelist()[-1] == "meta.json"
        for member in archive.infolist():
            assert (member.compress_type, member.flag_bits, member.extra) == (zipfile.ZIP_STORED, 0, b"")
            assert member.date_time == (1980, 1, 1, 0, 0, 0)
            assert (member.create_system, member.external_attr) == (3, 0o100644 << 16)
    assert data[-22:-18] == b"PK\5\6"  # PlayCanvas looks for the end there


def test_threads_do_not_change_a_byte() -> None:
    scene = Scene(random_splats(3000, sh_degree=2))
    expected = b"".join(sog.encode(scene))
    for threads in (2, 5):
        assert b"".join(sog.encode(scene, threads=threads)) == expected


def test_neighbours_in_a_file_are_neighbours_in_space() -> None:
    scene = Scene(random_splats(4000))
    found = decode_file(sog, io.BytesIO(b"".join(sog.encode(scene)))).splats.center
    kept = back(scene).center
    steps = [np.median(np.linalg.norm(np.diff(each, axis=0), axis=1)) for each in (found, kept)]
    assert steps[0] < steps[1] / 5
    assert np.abs(kept - scene.splats.center).max() < 1e-3  # in_order
    np.testing.assert_array_equal(np.sort(found, axis=0), np.sort(kept, axis=0))


@pytest.mark.parametrize("name", ["sh0", "sh1", "sh2", "sh3", "flat", "needle", "coincident", "huge", "one"])
def test_writing_a_decoded_scene_again_changes_next_to_nothing(name: str) -> None:
    once = decode_file(sog, io.BytesIO(b"".join(sog.encode(read_scene(FIXTURES / f"{name}.ply")))))
    twice = decode_file(sog, io.BytesIO(b"".join(sog.encode(once))))
    for column in COLUMNS:
        one, two = getattr(once.splats, column), getattr(twice.splats, column)
        if column == "quat_xyzw":  # of two components that are nearly the largest, the other one may be left out
            off = 1 - np.abs(np.einsum("ij,ij->i", one.astype(np.float64), two))
            assert np.count_nonzero(off > 1e-6) <= len(one) / 20
            assert off.max() < 1e-4
        else:
            np.testing.assert_allclose(two, one, rtol=3e-6, atol=3e-6, err_msg=column)


def test_a_scale_of_0_stays_0_and_the_largest_and_the_smallest_stay() -> None:
    splats = random_splats(2000)
    splats.scale[7], splats.scale[8] = [0, 0.01, 0], 1e-20
    splats.scale[9] = 5e4
    found = back(Scene(splats)).scale
    np.testing.assert_array_equal(found[7] == 0, [True, False, True])
    np.testing.assert_allclose(found[9], 5e4, rtol=1e-5)
    assert ((found == 0) == (splats.scale == 0)).all()


def test_scales_of_any_range_grow_by_a_third_at_most() -> None:
    splats = random_splats(300)
    splats.scale[:] = np.geomspace(1e-24, 1e37, 900).reshape(300, 3)
    splats.scale[0, 0] = 0
    found = back(Scene(splats)).scale
    assert (found <= splats.scale * 1.36).all()
    assert found[0, 0] == 0


def test_colours_of_splats_of_opacity_0_stay() -> None:
    splats = random_splats(50)
    splats.opacity[:] = 0
    found = back(Scene(splats))
    assert (found.opacity == 0).all()
    np.testing.assert_allclose(found.rgb, splats.rgb, atol=1e-6)


@st.composite
def hard_splats(draw: st.DrawFn) -> Splats:
    """A few splats of values from all over the range of float32."""
    count, degree = draw(st.integers(1, 12)), draw(st.integers(0, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def column(shape: tuple[int, ...], most: int, least: int = -44) -> np.ndarray:
        powers = rng.uniform(least, most, shape) * rng.integers(0, 2, shape)
        return (rng.choice([-1.0, 0.0, 1.0], shape) * 10.0**powers).astype(np.float32)

    return Splats(
        center=column((count, 3), 38),
        scale=np.abs(column((count, 3), 38)),
        quat_xyzw=np.ascontiguousarray(normalized_quat(rng.normal(size=(count, 4)).astype(np.float32))),
        opacity=rng.choice(np.float32([0, 1e-30, 0.5, 1]), count),
        rgb=column((count, 3), 14),
        sh=column((count, COEFFICIENTS[degree], 3), 14),
    )


@given(hard_splats())
def test_values_of_any_size_come_back(splats: Splats) -> None:
    found = back(Scene(splats))
    signed = [np.sign(each) * np.log1p(np.abs(each.astype(np.float64))) for each in (found.center, splats.center)]
    assert (np.abs(signed[0] - signed[1]) <= np.ptp(signed[1], axis=0) / 65535 / 2 * 1.001 + 1e-6).all()
    visible = splats.scale > 1e-37  # float32 logarithms of what lies below have few digits
    np.testing.assert_allclose(found.scale[visible], splats.scale[visible], rtol=3e-5)
    assert (found.scale[splats.scale == 0] == 0).all()
    assert np.abs(found.opacity - splats.opacity).max() <= 0.5001 / 255
    np.testing.assert_allclose(found.rgb, splats.rgb, rtol=1e-6, atol=1e-6)
    if np.unique(splats.sh).size <= 256:
        np.testing.assert_array_equal(found.sh, splats.sh)


@pytest.mark.parametrize(("codes", "expected"), [(None, 1024), (7, 7), (65_536, 1100)])
def test_a_palette_has_as_many_codes_as_suit_or_as_are_asked_for(codes: int | None, expected: int) -> None:
    scene = Scene(random_splats(1100, sh_degree=1))
    how = WriteOptions(sog=SogOptions(sh_codes=codes))
    assert sog.settled(scene, how).sog.sh_codes == (codes or 1024)
    assert meta_of(scene, options=how)["shN"]["count"] == expected
    error = np.abs(back(scene, options=how).sh - scene.splats.sh).max()
    assert (error < 0.05) == (expected >= 1100)


def test_palettes_are_as_large_as_those_of_splat_transform() -> None:
    expected = {1: 1024, 1024: 1024, 2047: 1024, 2048: 2048, 5000: 4096, 65_535: 32_768, 65_536: 65_536, 10**8: 65_536}
    assert {count: sog.codes_for(count) for count in expected} == expected


@pytest.mark.parametrize("count", [1, 15, 16, 17, 4096, 4097, 500_000, 16_380**2])
def test_images_hold_all_splats_in_about_a_square(count: int) -> None:
    width, height = sog_container.size_for(count)
    assert width * height >= count
    assert (width % 4, height % 4) == (0, 0)
    assert height <= width <= webp.MAX_SIDE
    assert width * (height - 4) < count


def changed(**columns: np.ndarray) -> Scene:
    splats = random_splats(4, sh_degree=1)
    whole = {}
    for name, value in columns.items():
        whole[name] = getattr(splats, name).copy()
        whole[name][2] = value
    return Scene(dataclasses.replace(splats, **whole))


REFUSED = {
    "an opacity above 1": (changed(opacity=np.float32(1.5)), "opacities reach 1.5, and SOG holds 0 to 1"),
    "a colour": (changed(rgb=np.float32([0, -2e15, 0])), "colours reach 2e[+]15"),
    "a coefficient": (changed(sh=np.full((3, 3), 3e38, np.float32)), "spherical harmonics reach 3e[+]38"),
    "no splats": (Scene(Splats.empty(0, 0)), "at least one splat"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_sog_cannot_hold_is_refused_before_a_byte_is_written(what: str) -> None:
    scene, message = REFUSED[what]
    with pytest.raises(FormatError, match=message):
        next(sog.encode(scene))


def test_more_splats_than_an_image_has_texels_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog, "MAX_SIDE", 7)
    sog.settled(Scene(random_splats(16)), WriteOptions())
    with pytest.raises(FormatError, match="17 splats; a SOG holds at most 16"):
        sog.settled(Scene(random_splats(17)), WriteOptions())


@pytest.mark.parametrize("codes", [0, 65_537])
def test_palettes_of_no_code_or_too_many_are_refused(codes: int) -> None:
    with pytest.raises(ValueError, match=f"sh_codes is {codes}"):
        sog.settled(Scene(random_splats(2)), WriteOptions(sog=SogOptions(sh_codes=codes)))
