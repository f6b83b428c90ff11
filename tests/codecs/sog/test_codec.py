"""SOG: pixels by hand, what old and other writers do, and names that lead elsewhere."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fixtures import by_hand_sog
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.codecs.sog import codec as sog
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.splats import COLUMNS
from sparklod_cli.system.errors import FormatError
from tests.codecs.cases import linear
from tests.conftest import FIXTURES
from tests.scenes import random_splats

SH_C0 = 0.28209479177387814
FOLDER = FIXTURES / "golden" / "sh1-sog"
FILES = {path.name: path.read_bytes() for path in FOLDER.iterdir()}
META = json.loads(FILES["meta.json"])

Files = dict[str, bytes]


def decode(files: Mapping[str, bytes], **zipped: Any) -> Scene:
    return decode_file(sog, io.BytesIO(by_hand_sog.zipped(files, **zipped)))


def with_meta(meta: Mapping[str, Any], files: Mapping[str, bytes] = FILES) -> Files:
    return {**files, "meta.json": json.dumps(meta).encode()}


def image(*rows: tuple[int, ...]) -> bytes:
    """An image of 4 x 4 pixels, of which these are the first; the others are the last of them."""
    return by_hand_sog.webp(np.array([*rows, *[rows[-1]] * (16 - len(rows))], np.uint8).reshape(4, 4, -1))


def assert_same(one: Scene, other: Scene) -> None:
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(one.splats, column), getattr(other.splats, column), column)


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


def test_pixels_of_version_1_are_decoded_as_worked_out_by_hand() -> None:
    meta = {"means": LOGS | {"shape": [4, 3], "files": ["means_l.webp", "means_u.webp"]}}
    meta |= {"quats": {"shape": [4, 4], "encoding": "quaternion_packed", "files": ["q.webp"]}}
    meta |= {"scales": {"mins": [-1, 0, 1], "maxs": [0, 0, 3], "files": ["a.webp"]}}
    meta |= {"sh0": {"mins": [-1, 0, 1, -4], "maxs": [0, 0, 3, 6], "files": ["b.webp"]}}
    codes = (0, 0, 0, 102), (255, 255, 255, 255), (51, 51, 51, 0), (204, 0, 102, 51)
    files = POSITIONS | {"a.webp": image(*codes), "b.webp": image(*codes), "q.webp": QUATS}
    scene = decode(with_meta(meta, files))
    assert (scene.format, scene.splats.sh_degree) == ("SOG 1", 0)
    np.testing.assert_allclose(scene.splats.center[:3], CENTERS, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(scene.splats.quat_xyzw[:, [3, 0, 1, 2]], WXYZ, atol=2e-5)
    values = np.array([[-1, 0, 1], [0, 0, 3], [-0.8, 0, 1.4], [-0.2, 0, 1.8]])
    np.testing.assert_allclose(scene.splats.scale, np.exp(values), rtol=1e-6)
    np.testing.assert_allclose(scene.splats.rgb, 0.5 + SH_C0 * values, atol=1e-6)
    np.testing.assert_allclose(scene.splats.opacity, 1 / (1 + np.exp([0, -6, 4, 2])), atol=1e-6)


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


@pytest.mark.parametrize("antialias", [True, False, None])
def test_meta_tells_whether_a_scene_is_antialiased(antialias: bool | None) -> None:
    assert decode(with_meta(META | {"antialias": antialias})).antialiased is bool(antialias)


def test_a_codebook_may_begin_with_null() -> None:
    """Old writers left it out; it is as far below the second as the others are from one another on average."""
    meta = json.loads(version_2()["meta.json"])
    book = [None, *np.linspace(1, 2, 255)]
    splats = decode(with_meta(meta | {"scales": meta["scales"] | {"codebook": book}}, version_2())).splats
    np.testing.assert_allclose(np.log(splats.scale[0, :2]), [1 - 1 / 255, 1], atol=1e-6)


@pytest.mark.parametrize("folder", ["", "scene/", "a/b/"])
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_folders_and_compression_of_the_zip_make_no_difference(folder: str, method: int) -> None:
    assert_same(decode(FILES, folder=folder, method=method), read_scene(FOLDER))


def test_other_files_in_the_zip_and_an_order_of_their_own_make_no_difference() -> None:
    more = {
        "preview.png": b"no image",
        "old/means.webp": b"",
        "__MACOSX/._meta.json": b"",
        **dict(reversed(FILES.items())),
    }
    assert_same(decode(more), read_scene(FOLDER))


def test_a_comment_and_bytes_before_the_zip_make_no_difference(tmp_path: Path) -> None:
    file = io.BytesIO(by_hand_sog.zipped(FILES))
    with zipfile.ZipFile(file, "a") as archive:
        archive.comment = b"made by hand"
    assert_same(decode_file(sog, io.BytesIO(file.getvalue())), read_scene(FOLDER))


@pytest.mark.parametrize("path", ["", "meta.json"])
def test_a_folder_is_read_by_its_name_and_that_of_its_meta(path: str) -> None:
    scene = read_scene(FOLDER / path)
    assert (scene.format, len(scene.splats), scene.splats.sh_degree) == ("SOG 2", 60, 1)


def test_a_meta_may_have_another_name_and_space_before_it(tmp_path: Path) -> None:
    for name, data in FILES.items():
        (tmp_path / name.replace("meta.json", "scene.txt")).write_bytes(b"\r\n\t " * (name == "meta.json") + data)
    assert_same(read_scene(tmp_path / "scene.txt"), read_scene(FOLDER))


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
    assert "\n" not in str(caught.value)
    assert "\0" not in str(caught.value)


@pytest.mark.skipif(os.name != "posix", reason="links are for POSIX")
def test_a_link_is_followed(tmp_path: Path) -> None:
    """Whoever made it could have made a copy."""
    folder = unpacked(tmp_path, FILES)
    (folder / "means_l.webp").unlink()
    (folder / "means_l.webp").symlink_to(tmp_path / "secret.webp")
    assert_same(read_scene(folder), read_scene(FOLDER))


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


def changed(*way: str, value: Any) -> Files:
    """The files, with another value in meta.json; without it, if that is `...`."""
    meta = json.loads(FILES["meta.json"])
    inner = meta
    for key in way[:-1]:
        inner = inner[key]
    inner[way[-1]] = value
    if value is ...:
        del inner[way[-1]]
    return with_meta(meta)


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


REFUSED: dict[str, tuple[Callable[[], Files], str]] = {
    "version 3": (lambda: changed("version", value=3), "SOG version 3 is unknown"),
    "no splats": (lambda: changed("count", value=0), "0 splats"),
    "more splats than pixels": (lambda: changed("count", value=65), "64 texels for 65 splats"),
    "a count of a half": (lambda: changed("count", value=59.5), "count of meta.json: expected a whole number"),
    "no count": (lambda: changed("count", value=...), "count of meta.json: expected .* but it is missing"),
    "no means": (lambda: changed("means", value=...), "means of meta.json: expected an object, but it is missing"),
    "two axes": (
        lambda: changed("means", "mins", value=[0, 0]),
        "means.mins of meta.json: expected a list of 3",
    ),
    "bounds of no number": (
        lambda: changed("means", "maxs", value=[0, "1", 2]),
        "maxs.1. of meta.json: expected",
    ),
    "infinite bounds": (
        lambda: changed("means", "maxs", value=[0, 1, float("inf")]),
        "expected a number .* not inf",
    ),
    "a short codebook": (lambda: changed("scales", "codebook", value=[0] * 255), "expected a list of 256 numbers"),
    "a null in a codebook": (
        lambda: changed("scales", "codebook", value=[0, None] + [0] * 254),
        "codebook.1. of meta.json: expected a number",
    ),
    "a name of no text": (
        lambda: changed("quats", "files", value=[7]),
        "quats.files.0. of meta.json: expected a text, not 7",
    ),
    "no second file": (
        lambda: changed("means", "files", value=["means_l.webp"]),
        "means.files.1. of .* it is missing",
    ),
    "other bands": (lambda: changed("shN", "bands", value=2), "has 3 coefficients, not those of 2 bands"),
    "no image": (lambda: without("quats.webp"), "'quats.webp', which is not in the archive"),
    "no meta": (lambda: without("meta.json"), "without meta.json"),
    "text": (lambda: FILES | {"quats.webp": b"something else that is long enough"}, "'quats.webp' is not a WebP image"),
    "half an image": (lambda: FILES | {"quats.webp": FILES["quats.webp"][:150]}, "is a corrupt WebP image"),
    "an animation": (lambda: FILES | {"quats.webp": animation(3)}, "'quats.webp' is an animation"),
    "a small image": (lambda: FILES | {"quats.webp": SMALL}, "'quats.webp' has 16 texels for 60 splats"),
    "a small image of labels": (lambda: FILES | {"shN_labels.webp": SMALL}, "has 16 texels for 60 splats"),
    "centroids of another width": (
        lambda: FILES | {"shN_centroids.webp": FILES["sh0.webp"]},
        "shN_centroids|centroids",
    ),
    "no JSON": (lambda: FILES | {"meta.json": b"{'version': 2}"}, "meta.json is not JSON"),
    "a list": (lambda: FILES | {"meta.json": b"[2]"}, "meta.json is not that of a SOG"),
    "another object": (lambda: FILES | {"meta.json": b'{"version": 2}'}, "meta.json is not that of a SOG"),
    "bytes that are no text": (lambda: FILES | {"meta.json": b'{"version": "\xff"}'}, "meta.json is not JSON"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_sog_is_refused_with_a_reason(what: str) -> None:
    make, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(make())


def test_a_folder_without_its_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"without the meta\.json of an unpacked SOG"):
        read_scene(tmp_path)
    (tmp_path / "meta.json").write_bytes(FILES["meta.json"])
    with pytest.raises(FormatError, match=r"means_l\.webp.*no such file"):
        read_scene(tmp_path)


@pytest.mark.parametrize(
    "name", ["\ud800.webp", "\udcff.webp", "\0.webp", "\x1b[2J\n.webp", "x" * 3000, "../a.webp", "", "."]
)
def test_a_missing_image_is_named_in_one_line(name: str, tmp_path: Path) -> None:
    meta = json.loads(FILES["meta.json"])
    meta["quats"]["files"] = [name]
    for file, data in (FILES | {"meta.json": json.dumps(meta).encode()}).items():
        (tmp_path / file).write_bytes(data)
    for source in (tmp_path, tmp_path / "zipped.sog"):
        if source != tmp_path:
            source.write_bytes(by_hand_sog.zipped(FILES | {"meta.json": json.dumps(meta).encode()}))
        with pytest.raises(FormatError, match=r"names|which it names") as caught:
            read_scene(source)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 250
