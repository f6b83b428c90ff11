"""COLMAP's text models as other programs and hands write them: with, without and with some lines of points."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cameras.camera_files import read, read_path
from sparklod_cli.cameras.formats.parsing import Files
from sparklod_cli.system.errors import CameraPathError
from tests.cameras.known import FOLDER, KNOWN, check_pose, files_at, text_file

HEAD = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
COUNTED = HEAD + "# Number of images: 4, mean observations per image: 0\n"

CAMERAS = "1 PINHOLE 640 480 500 500 320 240\n"

POINTS = "10.5 20.5 -1 7 8 12 0 1 0 1 1 1"


def image(number: int, name: str | None = None) -> str:
    return f"{number} 1 0 0 0 0 0 {5 + number} 1 {name or f'i{number}.jpg'}"


def model(images: str | bytes, cameras: str | bytes = CAMERAS) -> Files:
    contents = {"images.txt": images, "cameras.txt": cameras}
    return Files(
        Path("sparse"), {name: text if isinstance(text, bytes) else text.encode() for name, text in contents.items()}
    )


def names(images: str | bytes) -> list[str]:
    return [camera.name for camera in read(model(images)).cameras]


ALL = [f"i{number}.jpg" for number in range(4)]

#: What follows each of four images.
LAYOUTS = {
    "lines of points": [f"\n{POINTS}\n"] * 4,
    "empty lines of points": ["\n\n"] * 4,
    "no lines of points": ["\n"] * 4,
    "no empty lines of points": ["\n", f"\n{POINTS}\n", "\n", f"\n{POINTS}\n"],
    "no newline at the end": ["\n", "\n", "\n", ""],
    "blank lines between all lines": [f"\n\n{POINTS}\n\n"] * 4,
    "blanks for points": ["\n  \t\n"] * 4,
    "comments between": ["\n# more\n", f"\n# points\n{POINTS}\n", "\n", "\n"],
    "Windows' ends of lines": [f"\r\n{POINTS}\r\n", "\r\n\r\n", "\r\n", "\r\n"],
    "whole numbers for points": ["\n1 1 0 0 0 0\n", "\n512 256 9\n", "\n3 1 0 0 0 0 0 5 1\n", "\n"],
    "numbers of points as floats": ["\n1.5 2.5 -1.0\n"] * 4,
}


@pytest.mark.parametrize("head", ["", HEAD, COUNTED, "# by another program\n", "\ufeff", "\ufeff" + COUNTED])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_image_is_read_whatever_lines_of_points_follow(layout: str, head: str) -> None:
    images = head + "".join(image(number) + end for number, end in enumerate(LAYOUTS[layout]))
    assert names(images) == ALL
    assert [camera.name for camera in read(text_file(images, "renamed.dat")).cameras] == ALL


@pytest.mark.parametrize("between", ["\n", "\n\n", f"\n{POINTS}\n"])
@pytest.mark.parametrize("name", ["7", "0012", "3.5", "a b.jpg", "1 2.jpg", "-1", "2024 10 3"])
def test_a_name_may_be_a_number_or_have_blanks(name: str, between: str) -> None:
    assert names("".join(image(number, name) + between for number in range(4))) == [name] * 4


@pytest.mark.parametrize(
    ("images", "said"),
    [
        (COUNTED + "\n".join(map(image, range(3))), r"images.txt has 3 images, but its comment announces 4"),
        (COUNTED + "\n\n".join(map(image, range(5))), r"images.txt has 5 images, but its comment announces 4"),
        (image(0) + "\n1 1 0 0 0 0 0 x 1 i1.jpg\n", "line 2 of images.txt has 'x', which is not a finite number"),
        (image(0) + "\n1 1 0 0 0 0 0 5 i1.jpg\n", "line 2 of images.txt has 9 values, an image has 10"),
        (image(0) + f"\n{POINTS}\n{POINTS}\n", "line 3 of images.txt has 10.5, which is not a whole number"),
        (f"{POINTS}\n" + image(0), "line 1 of images.txt has 10.5, which is not a whole number"),
        (image(0) + "\n1 2\n", "line 2 of images.txt has 2 values"),
        (image(0) + "\n1 1 0 0 0 0 0 5 1.5 i1.jpg\n", "line 2 of images.txt has 1.5, which is not a whole number"),
    ],
)
def test_a_line_that_is_neither_an_image_nor_points_is_refused(images: str, said: str) -> None:
    with pytest.raises(CameraPathError, match=said):
        read(model(images))


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ("# Number of cameras: 2\n" + CAMERAS, "cameras.txt has 1 cameras, but its comment announces 2"),
        ("# nothing\n", "image 0 has camera 1, which does not exist"),
    ],
)
def test_lost_lenses_are_refused(cameras: str, said: str) -> None:
    with pytest.raises(CameraPathError, match=said):
        read(model(image(0), cameras))


def test_text_without_comments_is_found_by_its_names_and_its_lines(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text(image(0) + "\n\n" + image(1) + "\n\n")
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    for path in (tmp_path, tmp_path / "images.txt", tmp_path / "cameras.txt"):
        found = read_path(path)
        assert (found.format, len(found), found.cameras[0].focal) == ("COLMAP", 2, (500, 500))
    (tmp_path / "cameras.txt").unlink()
    assert len(read_path(tmp_path / "images.txt")) == 2
    (tmp_path / "images.txt").rename(tmp_path / "poses")
    assert len(read_path(tmp_path / "poses")) == 2


def test_the_names_of_a_folder_decide_over_the_lines(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text("1 2 3\n")
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    with pytest.raises(CameraPathError, match=r"line 1 of images.txt has 3 values, an image has 10"):
        read_path(tmp_path)


@pytest.mark.parametrize("content", ["1 0 0 0 0 0 0 1\n", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "1 3 0 0 0 0 0 5 1 a.jpg\n"])
def test_other_lines_of_numbers_are_not_taken_for_images(content: str) -> None:
    try:
        assert read(text_file(content, "x.txt")).format != "COLMAP"
    except CameraPathError as error:
        assert "of no known format" in str(error)


@pytest.mark.parametrize("file", ["images.bin", "cameras.bin"])
def test_bytes_after_the_announced_items_are_refused(file: str) -> None:
    whole = files_at(FOLDER / "colmap-binary")
    count = 4 if file == "images.bin" else 1
    with pytest.raises(CameraPathError, match=f"{file} has 5 bytes after the {count} items that it announces"):
        read(Files(whole.path, {**whole.contents, file: whole.contents[file] + b"spare"}))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize(
    "name", ["inria.json", "sparklod.json", "sparklod.csv", "tum.txt", "open3d.log", "transforms.json", "colmap-text"]
)
def test_a_byte_order_mark_changes_nothing(name: str, encoding: str) -> None:
    whole = files_at(FOLDER / name)
    mark = "" if encoding in ("utf-8-sig", "utf-16") else "\ufeff"
    marked = {file: (mark + data.decode()).encode(encoding) for file, data in whole.contents.items()}
    path = read(Files(whole.path, marked))
    assert path.format == read(whole).format
    for camera, known in zip(path.cameras, KNOWN, strict=True):
        check_pose(camera, known)
