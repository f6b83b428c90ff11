"""SOG: pixels by hand, what writers vary, names that lead elsewhere; as it is written; and images with losses."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import sparklod_cli
from fixtures import by_hand_sog
from sparklod_cli.cli import run
from sparklod_cli.codecs import sog
from sparklod_cli.codecs.formats import SogOptions, WriteOptions
from sparklod_cli.codecs.sog_images import MOST_BEFORE, pixels_of, read_header
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.gaussian import normalized_quat
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.sh import COEFFICIENTS
from sparklod_cli.model.splats import COLUMNS, Splats
from sparklod_cli.system.errors import FormatError
from tests.codecs import cases
from tests.codecs.cases import assert_same, linear
from tests.codecs.damage import replaced
from tests.conftest import FIXTURES, Capture
from tests.scenes import random_splats

SH_C0 = 0.28209479177387814
FOLDER = FIXTURES / "golden" / "sh1-sog"
FILES = {path.name: path.read_bytes() for path in FOLDER.iterdir()}
META = json.loads(FILES["meta.json"])

Files = dict[str, bytes]


def decode(files: Mapping[str, bytes]) -> Scene:
    return cases.decode(sog, by_hand_sog.zipped(files))


def with_meta(meta: Mapping[str, Any], files: Mapping[str, bytes] = FILES) -> Files:
    return {**files, "meta.json": json.dumps(meta).encode()}


def image(*rows: tuple[int, ...]) -> bytes:
    """An image of 4 x 4 pixels, of which these are the first; the others are the last of them."""
    return by_hand_sog.webp(np.array([*rows, *[rows[-1]] * (16 - len(rows))], np.uint8).reshape(4, 4, -1))


# --- Values -----------------------------------------------------------------------------------------------------------

POSITIONS = {
    "means_l.webp": image((0, 0, 0, 255), (255, 255, 255, 255), (0, 255, 1, 255)),
    "means_u.webp": image((0, 0, 0, 255), (255, 255, 255, 255), (128, 127, 0, 255)),
}
LOGS = {"mins": [-np.log(3), 0, 1], "maxs": [np.log(3), np.log(11), 1]}
CENTERS = [[-2, 0, np.e - 1], [2, 10, np.e - 1], [np.expm1(np.log(3) / 65535), np.expm1(np.log(11) * 32767 / 65535)]]
CENTERS[2].append(np.e - 1)
QUATS = image((255, 0, 128, 252), (0, 128, 128, 253), (128, 128, 255, 254), (51, 102, 153, 255))
HALF, LITTLE, FIFTH = 0.5**0.5, 1 / 255 * 0.5**0.5, 0.2 * 0.5**0.5
LAST = (1 - (9 + 1 + 1) * FIFTH**2) ** 0.5
#: By what the largest is: w, x, y, z.
WXYZ = [[0, HALF, -HALF, LITTLE], [-HALF, HALF, LITTLE, LITTLE], [LITTLE, LITTLE, HALF, HALF]]
WXYZ.append([-3 * FIFTH, -FIFTH, FIFTH, LAST])


def version_2() -> Files:
    book = [0.0] * 256
    book[:4] = [-1.0, 2.0, 0.5, -3.0]
    meta = {"version": 2, "count": 4, "means": LOGS | {"files": ["means_l.webp", "means_u.webp"]}}
    meta |= {"scales": {"codebook": book, "files": ["a.webp"]}, "quats": {"files": ["q.webp"]}}
    meta |= {"sh0": {"codebook": book, "files": ["b.webp"]}}
    codes = (0, 1, 2, 0), (3, 3, 0, 255), (255, 0, 0, 51), (1, 1, 1, 1)
    return with_meta(meta, POSITIONS | {"a.webp": image(*codes), "b.webp": image(*codes), "q.webp": QUATS})


def test_pixels_of_version_2_are_decoded_as_worked_out_by_hand() -> None:
    scene = decode(version_2())
    splats = scene.splats
    assert (scene.format, scene.antialiased, scene.notes, splats.sh_degree) == ("SOG 2", False, (), 0)
    np.testing.assert_allclose(splats.center[:3], CENTERS, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(splats.quat_xyzw[:, [3, 0, 1, 2]], WXYZ, atol=2e-5)
    values = np.array([[-1, 2, 0.5], [-3, -3, -1], [0, -1, -1], [2, 2, 2]])
    np.testing.assert_allclose(splats.scale, np.exp(values), rtol=1e-6)
    np.testing.assert_allclose(splats.rgb, 0.5 + SH_C0 * values, atol=1e-6)  # also of the one that is transparent
    np.testing.assert_allclose(splats.opacity, [0, 1, 0.2, 1 / 255], atol=1e-7)


def test_sh_are_looked_up_by_label_row_and_coefficient() -> None:
    """65 centroids of degree 1, whose image is 192 wide; red of coefficient k of centroid c is 4 * (c % 64) + k."""
    pixels = np.zeros((2, 192, 4), np.uint8)
    pixels[..., 0], pixels[1, :, 1], pixels[..., 2], pixels[..., 3] = (
        np.arange(192) // 3 * 4 + np.arange(192) % 3,
        9,
        7,
        255,
    )
    files = version_2() | {"c.webp": by_hand_sog.webp(pixels)}
    files["l.webp"] = image((0, 0, 0, 255), (63, 0, 0, 255), (64, 0, 0, 255), (2, 0, 9, 255))
    book = (np.arange(256) / 8).tolist()
    shn = {"bands": 1, "count": 65, "codebook": book, "files": ["c.webp", "l.webp"]}
    sh = decode(with_meta(json.loads(files["meta.json"]) | {"shN": shn}, files)).splats.sh * 8
    np.testing.assert_array_equal(sh[:, :, 0], [[0, 1, 2], [252, 253, 254], [0, 1, 2], [8, 9, 10]])
    np.testing.assert_array_equal(sh[:, :, 1], [[0] * 3, [0] * 3, [9] * 3, [0] * 3])
    np.testing.assert_array_equal(sh[:, :, 2], np.full((4, 3), 7))
    with pytest.raises(FormatError, match="an SH label is beyond the 64 entries of its palette"):
        decode(with_meta(json.loads(files["meta.json"]) | {"shN": shn | {"count": 64}}, files))


# --- What writers vary ------------------------------------------------------------------------------------------------


def test_an_image_without_alpha_is_opaque() -> None:
    """Encoders drop alpha where all of it is 255: rotations whose z is the largest, and splats that are opaque."""
    files = version_2()
    files |= {"q.webp": image((128, 128, 128)), "b.webp": image((0, 1, 2))}
    splats = decode(files).splats
    np.testing.assert_allclose(splats.quat_xyzw, [[LITTLE, LITTLE, 1, LITTLE]] * 4, atol=2e-5)
    assert (splats.opacity == 1).all()


def test_a_rotation_without_a_valid_tag_is_nan() -> None:
    quats = decode(version_2() | {"q.webp": image((128, 128, 128, 251), (128, 128, 128, 252))}).splats.quat_xyzw
    assert np.isnan(quats).any(axis=1).tolist() == [True, False, False, False]


def test_a_codebook_may_begin_with_null() -> None:
    """Old writers left it out; it is as far below the second as the others are from one another on average."""
    meta = json.loads(version_2()["meta.json"])
    book = [None, *np.linspace(1, 2, 255)]
    splats = decode(with_meta(meta | {"scales": meta["scales"] | {"codebook": book}}, version_2())).splats
    np.testing.assert_allclose(np.log(splats.scale[0, :2]), [1 - 1 / 255, 1], atol=1e-6)


def test_a_meta_may_have_another_name_and_space_before_it(tmp_path: Path) -> None:
    for name, data in FILES.items():
        (tmp_path / name.replace("meta.json", "scene.txt")).write_bytes(b"\r\n\t " * (name == "meta.json") + data)
    assert_same(read_scene(tmp_path / "scene.txt").splats, read_scene(FOLDER).splats)


def test_images_may_be_larger_than_they_need_be() -> None:
    splats = random_splats(10)
    files = by_hand_sog.sog_files(**linear(Scene(splats)))
    wide = np.zeros((8, 12, 4), np.uint8)
    wide[..., 3] = 252
    larger = decode(files | {"quats.webp": by_hand_sog.webp(wide)})
    assert len(larger.splats) == 10


# --- Names that lead elsewhere ----------------------------------------------------------------------------------------

OUTSIDE = (
    *("../secret.webp", "..", ".", "", "/etc/hostname", "sub/secret.webp", "./means_l.webp", "sub\\secret.webp"),
    *("C:\\secret.webp", "C:secret.webp", "\\\\host\\share", "a\0b", "file:///etc/hostname", "~", "missing.webp"),
    *("\ud800.webp", "\udcff.webp", "\x1b[2J\n.webp", "x" * 3000),
)


def unpacked(directory: Path, files: Mapping[str, bytes]) -> Path:
    """A folder of these files, beside and in which there are others that must not be read."""
    (directory / "scene" / "sub").mkdir(parents=True)
    for name, data in files.items():
        (directory / "scene" / name).write_bytes(data)
    for secret in ("secret.webp", "scene/sub/secret.webp"):
        (directory / secret).write_bytes(FILES["means_l.webp"])
    return directory / "scene"


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("zipped", [False, True])
def test_a_name_that_leads_elsewhere_is_refused(name: str, zipped: bool, tmp_path: Path) -> None:
    meta = META | {"means": META["means"] | {"files": [name, "means_u.webp"]}}
    path = unpacked(tmp_path, with_meta(meta))
    if zipped:
        path = path.with_suffix(".sog")
        path.write_bytes(by_hand_sog.zipped(with_meta(meta)))
    with pytest.raises(FormatError) as caught:
        read_scene(path)
    assert "names" in str(caught.value) or "is a directory" in str(caught.value)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 300


@pytest.mark.skipif(os.name != "posix", reason="links are for POSIX")
def test_a_link_is_followed(tmp_path: Path) -> None:
    """Whoever made it could have made a copy."""
    folder = unpacked(tmp_path, FILES)
    (folder / "means_l.webp").unlink()
    (folder / "means_l.webp").symlink_to(tmp_path / "secret.webp")
    assert_same(read_scene(folder).splats, read_scene(FOLDER).splats)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
def test_a_pipe_in_the_folder_is_not_waited_for(tmp_path: Path) -> None:
    folder = unpacked(tmp_path, FILES)
    (folder / "means_l.webp").unlink()
    os.mkfifo(folder / "means_l.webp")
    code = (
        f"from pathlib import Path; from sparklod_cli.io.reading import read_scene; read_scene(Path({str(folder)!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert "FormatError: " in done.stderr
    assert "means_l.webp" in done.stderr.splitlines()[-1]


# --- Errors -----------------------------------------------------------------------------------------------------------


def without(name: str) -> Files:
    return {other: data for other, data in FILES.items() if other != name}


SMALL = image((0, 0, 0, 252))


def animation(frames: int) -> bytes:
    """The image of quaternions, and others after it."""
    out = io.BytesIO()
    first = Image.open(io.BytesIO(FILES["quats.webp"])).convert("RGBA")
    more = [Image.eval(first, lambda byte, by=number: byte ^ by) for number in range(1, frames)]
    first.save(out, "WEBP", lossless=True, exact=True, save_all=True, append_images=more)
    assert getattr(Image.open(io.BytesIO(out.getvalue())), "n_frames", 1) == frames
    return out.getvalue()


#: What is wrong with meta.json: where another value is, by keys, that value, `...` for none, and the reason.
EDITS: dict[str, tuple[tuple[str, ...], Any, str]] = {
    "version 3": (("version",), 3, "SOG version 3 is unknown"),
    "no splats": (("count",), 0, "0 splats"),
    "more splats than pixels": (("count",), 65, "64 texels for 65 splats"),
    "no count": (("count",), ..., "count of meta.json: expected .* but it is missing"),
    "no means": (("means",), ..., "means of meta.json: expected an object, but it is missing"),
    "two axes": (("means", "mins"), [0, 0], "means.mins of meta.json: expected a list of 3"),
    "infinite bounds": (("means", "maxs"), [0, 1, float("inf")], "expected a number .* not inf"),
    "a short codebook": (("scales", "codebook"), [0] * 255, "expected a list of 256 numbers"),
    "no second file": (("means", "files"), ["means_l.webp"], "means.files.1. of .* it is missing"),
    "other bands": (("shN", "bands"), 2, "has 3 coefficients, not those of 2 bands"),
}
REFUSED = {name: (with_meta(replaced(META, way, value)), reason) for name, (way, value, reason) in EDITS.items()} | {
    "no image": (without("quats.webp"), "'quats.webp', which is not in the archive"),
    "no meta": (without("meta.json"), "without meta.json"),
    "text": (FILES | {"quats.webp": b"something else that is long enough"}, "'quats.webp' is not a WebP image"),
    "half an image": (FILES | {"quats.webp": FILES["quats.webp"][:150]}, "is a corrupt WebP image"),
    "an animation": (FILES | {"quats.webp": animation(3)}, "'quats.webp' is an animation"),
    "a small image": (FILES | {"quats.webp": SMALL}, "'quats.webp' has 16 texels for 60 splats"),
    "a small image of labels": (FILES | {"shN_labels.webp": SMALL}, "has 16 texels for 60 splats"),
    "centroids of another width": (FILES | {"shN_centroids.webp": FILES["sh0.webp"]}, "shN_centroids|centroids"),
    "no JSON": (FILES | {"meta.json": b"{'version': 2}"}, "meta.json is not JSON"),
    "another object": (FILES | {"meta.json": b'{"version": 2}'}, "meta.json is not that of a SOG"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_sog_is_refused_with_a_reason(what: str) -> None:
    files, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(files)


def test_a_folder_without_its_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"without the meta\.json of an unpacked SOG"):
        read_scene(tmp_path)
    (tmp_path / "meta.json").write_bytes(FILES["meta.json"])
    with pytest.raises(FormatError, match=r"means_l\.webp.*no such file"):
        read_scene(tmp_path)


# --- Written ----------------------------------------------------------------------------------------------------------


def files_of(scene: Scene, **how: Any) -> dict[str, bytes]:
    return dict(sog.encode_files(scene, **how))


def meta_of(scene: Scene, **how: Any) -> dict[str, Any]:
    meta: dict[str, Any] = json.loads(files_of(scene, **how)["meta.json"])
    return meta


def back(scene: Scene, **how: Any) -> Splats:
    """What is read of the files of a scene, in its order."""
    files = files_of(scene, in_order=True, **how)
    return unbundled(files).splats


def unbundled(files: Mapping[str, bytes]) -> Scene:
    return cases.decode(sog, files["meta.json"], open_companion=lambda name: io.BytesIO(files[name]))


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
        assert unbundled(files).antialiased is antialiased


def test_an_archive_holds_the_files_as_they_are_and_depends_on_no_clock() -> None:
    scene = Scene(random_splats(100, sh_degree=1))
    data = cases.encode(sog, scene)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == files_of(scene)
        assert archive.namelist()[-1] == "meta.json"
        for member in archive.infolist():
            assert (member.compress_type, member.flag_bits, member.extra) == (zipfile.ZIP_STORED, 0, b"")
            assert member.date_time == (1980, 1, 1, 0, 0, 0)
            assert (member.create_system, member.external_attr) == (3, 0o100644 << 16)
    assert data[-22:-18] == b"PK\5\6"  # PlayCanvas looks for the end there


def test_neighbours_in_a_file_are_neighbours_in_space() -> None:
    scene = Scene(random_splats(4000))
    found = cases.decode(sog, cases.encode(sog, scene)).splats.center
    kept = back(scene).center
    steps = [np.median(np.linalg.norm(np.diff(each, axis=0), axis=1)) for each in (found, kept)]
    assert steps[0] < steps[1] / 5
    assert np.abs(kept - scene.splats.center).max() < 1e-3  # in_order
    np.testing.assert_array_equal(np.sort(found, axis=0), np.sort(kept, axis=0))


@pytest.mark.parametrize("name", ["sh0", "sh1", "sh2", "sh3", "flat", "needle", "coincident", "huge", "one"])
def test_writing_a_decoded_scene_again_changes_next_to_nothing(name: str) -> None:
    once = cases.decode(sog, cases.encode(sog, read_scene(FIXTURES / f"{name}.ply")))
    twice = cases.decode(sog, cases.encode(sog, once))
    for column in COLUMNS:
        one, two = getattr(once.splats, column), getattr(twice.splats, column)
        if column == "quat_xyzw":  # of two components that are nearly the largest, the other one may be left out
            off = 1 - np.abs(np.einsum("ij,ij->i", one.astype(np.float64), two))
            assert np.count_nonzero(off > 1e-6) <= len(one) / 20
            assert off.max() < 1e-4
        else:
            np.testing.assert_allclose(two, one, rtol=3e-6, atol=3e-6, err_msg=column)


def test_scales_of_any_range_grow_by_a_third_at_most() -> None:
    splats = random_splats(300)
    splats.scale[:] = np.geomspace(1e-24, 1e37, 900).reshape(300, 3)
    splats.scale[0, 0] = 0
    found = back(Scene(splats)).scale
    assert (found <= splats.scale * 1.36).all()
    assert found[0, 0] == 0


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


def changed(**columns: np.ndarray) -> Scene:
    splats = random_splats(4, sh_degree=1)
    whole = {}
    for name, value in columns.items():
        whole[name] = getattr(splats, name).copy()
        whole[name][2] = value
    return Scene(dataclasses.replace(splats, **whole))


NOT_WRITTEN = {
    "an opacity above 1": (changed(opacity=np.float32(1.5)), "opacities reach 1.5, and SOG holds 0 to 1"),
    "a colour": (changed(rgb=np.float32([0, -2e15, 0])), "colours reach 2e[+]15"),
    "a coefficient": (changed(sh=np.full((3, 3), 3e38, np.float32)), "spherical harmonics reach 3e[+]38"),
    "no splats": (Scene(Splats.empty(0, 0)), "at least one splat"),
}


@pytest.mark.parametrize("what", NOT_WRITTEN)
def test_what_sog_cannot_hold_is_refused_before_a_byte_is_written(what: str) -> None:
    scene, message = NOT_WRITTEN[what]
    with pytest.raises(FormatError, match=message):
        next(sog.encode(scene))


def test_more_splats_than_an_image_has_texels_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog, "MAX_SIDE", 7)
    sog.settled(Scene(random_splats(16)), WriteOptions())
    with pytest.raises(FormatError, match="17 splats; a SOG holds at most 16"):
        sog.settled(Scene(random_splats(17)), WriteOptions())


# --- Lossy images: a finding, and a line when baking ------------------------------------------------------------------

STREAMED = FIXTURES / "golden" / "sh1-streamed-sog"
TEXT = "its images are lossy WebP"


def recoded(path: Path, **options: object) -> None:
    """Writes an image again, with losses unless `lossless`; the sides stay."""
    with Image.open(io.BytesIO(path.read_bytes())) as image:
        image.load()
    image.save(path, "WEBP", **{"quality": 90, "method": 0} | options)


@pytest.mark.parametrize("name", ["means_l", "means_u", "quats", "scales", "sh0", "shN_labels", "shN_centroids"])
@pytest.mark.parametrize("zipped", [False, True])
def test_a_lossy_image_is_a_finding_and_a_line(name: str, zipped: bool, tmp_path: Path, capsys: Capture) -> None:
    shutil.copytree(FOLDER, tmp_path, dirs_exist_ok=True)
    recoded(tmp_path / f"{name}.webp")
    path = tmp_path / "meta.json"
    if zipped:
        path = tmp_path / "scene.sog"
        path.write_bytes(by_hand_sog.zipped({each.name: each.read_bytes() for each in tmp_path.iterdir()}))
    assert run(["inspect", "--check", str(path)]) == 3
    out = capsys.readouterr().out
    assert f"{TEXT} ('{name}.webp'), so that values are not those written" in out
    if name == "shN_labels":
        assert "error: container.corrupt: an SH label is beyond the" in out
    else:
        assert "error: container.lossy: " in out
        assert run(["build-lod", str(path), "-o", str(tmp_path / "tree.spz")]) == 0
        assert capsys.readouterr().err.count(TEXT) == 1


@pytest.mark.parametrize("folder", ["0_0", "1_0", "env"])
def test_a_lossy_chunk_is_named(folder: str, tmp_path: Path, capsys: Capture) -> None:
    """Of full detail, of a coarser level, and of the environment."""
    shutil.copytree(STREAMED, tmp_path, dirs_exist_ok=True)
    recoded(tmp_path / folder / "sh0.webp")
    recoded(tmp_path / folder / "scales.webp")
    assert run(["inspect", "--check", str(tmp_path)]) == 3
    out = capsys.readouterr().out
    assert f"container.lossy: '{folder}/meta.json': {TEXT} ('scales.webp', 'sh0.webp')" in out
    assert out.count("container.lossy") == 1
    if folder != "1_0":  # which is not read
        assert run(["build-lod", str(tmp_path), "-o", str(tmp_path / "tree.spz")]) == 0
        assert capsys.readouterr().err.count(TEXT) == 1


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize("more", [{}, {"exif": b"Exif\0\0" + bytes(99)}, {"icc_profile": bytes(70_001)}])
@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_losses_are_told_behind_any_header(mode: str, more: dict[str, bytes], lossless: bool) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (8, 12, len(mode)), np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=lossless, exact=True, **more)
    read = io.BytesIO(file.getvalue()).read
    header = read_header(read, "x")
    assert (header.width, header.height, header.lossy) == (12, 8, not lossless)
    decoded = pixels_of(header, read, "x").view(np.uint8).reshape(8, 12, 4)[..., [2, 1, 0, 3]]
    assert (decoded[..., : len(mode)] == pixels).all() == lossless


def test_only_some_chunks_are_searched_for_the_pixels() -> None:
    start = b"RIFF\0\0\0\0WEBPVP8X\n\0\0\0" + bytes(10)
    for chunks, lossy in ((MOST_BEFORE - 1, True), (MOST_BEFORE, False)):
        data = start + b"ABCD\3\0\0\0abc\0" * chunks + b"VP8 \0\0\0\0"
        assert read_header(io.BytesIO(data).read, "x").lossy == lossy
