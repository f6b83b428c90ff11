"""Exported sites: whole or not at all, and never in the place of something else."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sparklod_cli.cli import run
from sparklod_cli.system.errors import OutputError
from sparklod_cli.view import site as exporting
from sparklod_cli.view.site import Site, check_folder, export
from tests.conftest import FIXTURES
from tests.view.conftest import TREE, prepared


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """A site with a file of one part, and with one of two."""
    chunked = tmp_path_factory.mktemp("chunked") / "chunked.rad"
    command = ["build-lod", str(FIXTURES / "sh1.ply"), "--format", "rad-chunked", "-o", str(chunked), "-q"]
    assert run(command) == 0
    return prepared([TREE, chunked], served=False)


def everything(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_site_has_every_resource_under_its_name(static: Site, tmp_path: Path) -> None:
    size = export(static, tmp_path / "deep" / "site", overwrite=False)
    found = everything(tmp_path / "deep" / "site")
    assert found.keys() == static.resources.keys()
    for name, content in static.resources.items():
        assert found[name] == (content if isinstance(content, bytes) else content.read_bytes())
    assert size == sum(map(len, found.values()))
    assert json.loads(found["view.json"])["cameras"] is None
    assert [path.name for path in tmp_path.rglob(".sparklod*")] == []


def test_the_libraries_are_copied_too(packages: Path, tmp_path: Path) -> None:
    site = prepared([TREE], served=False, spark_dir=packages)
    export(site, tmp_path / "site", overwrite=False)
    assert (tmp_path / "site/lib/three/build/three.core.js").is_file()
    assert (tmp_path / "site/lib/three/LICENSE").read_text() == "license of three"


def test_an_existing_folder_is_refused_and_replaced_only_if_it_is_a_site(static: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / "old.js").write_text("of the site before")
    with pytest.raises(OutputError, match=f"^{folder} exists, add --overwrite"):
        export(static, folder, overwrite=False)
    assert (folder / "old.js").exists()
    export(static, folder, overwrite=True)
    assert everything(folder).keys() == static.resources.keys()
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


@pytest.mark.parametrize("name", [".git/HEAD", "CNAME", "notes.txt"])
def test_what_somebody_put_into_the_folder_of_a_site_is_never_removed(static: Site, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("mine")
    with pytest.raises(
        OutputError, match=r"holds (\.git|CNAME|notes\.txt), which is not of the site; move it away first$"
    ):
        export(static, folder, overwrite=True)
    assert (folder / name).read_text() == "mine"


@pytest.mark.parametrize("content", [{"notes.txt": "mine"}, {"view.json": "{}"}, {"view.json": "no json"}])
def test_what_is_no_site_is_never_replaced(static: Site, tmp_path: Path, content: dict[str, str]) -> None:
    folder = tmp_path / "home"
    folder.mkdir()
    for name, text in content.items():
        (folder / name).write_text(text)
    with pytest.raises(OutputError, match="holds something else than a site"):
        export(static, folder, overwrite=True)
    assert {path.name: path.read_text() for path in folder.iterdir()} == content


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("golden/hand-v4.spz", "Spark 2.2.0 does not read SPZ version 4; bake it first with sparklod build-lod"),
        ("sh1-ascii.ply", "Spark 2.2.0 does not read PLY that is ascii or big-endian; bake it first"),
        ("golden/sh3-rad/sh3.rad", "Spark streams chunks of 65,536 nodes, not of 24; write it anew"),
    ],
)
def test_what_spark_does_not_read_is_not_exported(
    name: str, reason: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["view", str(TREE), str(FIXTURES / name), "--export", str(tmp_path / "site")]) == 1
    assert f"error: {FIXTURES / name}: {reason}" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_page_is_no_name_of_a_folder(static: Site, tmp_path: Path) -> None:
    with pytest.raises(
        OutputError, match=rf"page\.html names a page, but --export writes a folder; give {tmp_path}/page$"
    ):
        export(static, tmp_path / "page.html", overwrite=False)


def test_an_empty_folder_is_filled(static: Site, tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    export(static, tmp_path / "site", overwrite=False)
    assert (tmp_path / "site" / "index.html").is_file()


def test_a_file_is_no_folder(static: Site, tmp_path: Path) -> None:
    (tmp_path / "site").write_text("mine")
    with pytest.raises(OutputError, match="is a file"):
        check_folder(tmp_path / "site", overwrite=True)
    with pytest.raises(OutputError, match="cannot write"):
        export(static, tmp_path / "site" / "below", overwrite=True)


def test_a_site_that_shows_its_own_files_is_not_replaced(static: Site, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    again = prepared([folder / "data" / "0" / TREE.name], served=False)
    with pytest.raises(OutputError, match="which is to be shown"):
        export(again, folder, overwrite=True)
    assert everything(folder).keys() == static.resources.keys()


@pytest.mark.parametrize("error", [OSError("no space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", [True, False])
def test_a_failure_leaves_everything_as_it_was(
    static: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, before: bool
) -> None:
    folder = tmp_path / "site"
    if before:
        export(static, folder, overwrite=False)
        (folder / "old").write_text("of the site before")
    found = everything(tmp_path)
    write, calls = exporting.write_file, iter(range(100))

    def write_some(*arguments: object, **more: object) -> int:
        if next(calls) == 5:
            raise error
        return write(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(exporting, "write_file", write_some)
    with pytest.raises((OutputError, KeyboardInterrupt)):
        export(static, folder, overwrite=True)
    assert everything(tmp_path) == found
    assert folder.exists() == before


def test_a_folder_that_cannot_be_put_in_place_is_put_back(
    static: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "site"
    export(static, folder, overwrite=False)
    (folder / "old").write_text("of the site before")
    found, rename, calls = everything(tmp_path), Path.rename, iter(range(100))

    def rename_some(self: Path, target: Path) -> Path:
        if next(calls) == 1:
            raise OSError("cannot rename")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", rename_some)
    with pytest.raises(OutputError):
        export(static, folder, overwrite=True)
    assert everything(tmp_path) == found
