"""What a report says of a Streamed SOG: levels, regions, sizes, and what can be expected of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparklod_cli.cli import run
from sparklod_cli.codecs.streamed_manifest import MAX_MANIFEST
from sparklod_cli.inspection import html
from sparklod_cli.inspection.report import Report, ReportSettings, inspect
from sparklod_cli.io.reading import read_parts, read_scene
from tests.conftest import Capture
from tests.inspection.streamed_sog_files import COUNTS, Folder, Node, folder, regions


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder(sh_degree=1).write(tmp_path_factory.mktemp("streamed"))


@pytest.fixture(scope="module")
def report(path: Path) -> Report:
    return inspect(path, ReportSettings(values=True))[0]


def sizes(path: Path, *folders: str) -> int:
    return sum(file.stat().st_size for name in folders for file in (path.parent / name).iterdir())


def test_levels_are_counted_in_splats_regions_files_and_bytes(path: Path, report: Report) -> None:
    for level, found in enumerate(report.value_at("streamed_sog.levels")):
        splats = sum(row[level] for row in COUNTS)
        assert (found["splats"], found["regions"], found["files"]) == (splats, 2, 1)
        assert found["share"] == round(splats / sum(row[0] for row in COUNTS), 4)
        assert found["bytes"] == sizes(path, f"{level}_0")


def test_bytes_are_of_all_files_and_the_first_of_what_the_coarsest_level_takes(path: Path, report: Report) -> None:
    manifest = path.stat().st_size
    assert report.bytes == manifest + sizes(path, "0_0", "1_0", "2_0", "env")
    assert report.value_at("streamed_sog.bytes") == report.bytes
    assert report.value_at("streamed_sog.manifest_bytes") == manifest
    assert report.value_at("streamed_sog.first_bytes") == manifest + sizes(path, "2_0", "env")
    files = sorted(sizes(path, f"{level}_0") for level in range(3))
    assert report.value_at("streamed_sog.file_bytes") == dict(zip(("min", "median", "max"), files, strict=True))
    assert report.value_at("streamed_sog.environment") == {"splats": 5, "bytes": sizes(path, "env")}


def test_splats_and_values_are_those_of_full_detail_and_the_environment(path: Path, report: Report) -> None:
    scene = read_scene(path)
    assert report.splats == len(scene) == sum(row[0] for row in COUNTS) + 5
    assert report.value_at("values.box.max") == pytest.approx(scene.splats.center.max(axis=0), rel=1e-5)
    assert report.value_at("streamed_sog.splats") == sum(map(sum, COUNTS))
    assert (report.format, report.sh_degree) == ("Streamed SOG 1", 1)


def test_regions_have_quantiles_of_splats_and_edges(path: Path, report: Report) -> None:
    detail = read_parts(path)
    edges = np.ptp(detail.bounds, axis=1).max(axis=1)
    for name, values in (("region_splats", detail.counts[:, 0]), ("region_edge", edges)):
        found = report.value_at(f"streamed_sog.{name}")
        assert (found["min"], found["max"]) == pytest.approx((values.min(), values.max()), rel=1e-5)
        assert found["mean"] == pytest.approx(values.mean(), rel=1e-5)
        assert found["p50"] in (found["min"], found["max"])  # the value of a region, not one between two
    assert (report.value_at("streamed_sog.regions"), report.value_at("streamed_sog.depth")) == (2, 1)
    assert report.value_at("streamed_sog.bound.min") == detail.bounds[:, 0].min(axis=0).tolist()


def test_errors_are_weighted_by_splats_of_full_detail(tmp_path: Path) -> None:
    def change(manifest: Node) -> None:
        for node, error in zip(regions(manifest), (0.5, 0.25), strict=True):
            node["errors"] = [0, error, 2 * error]

    report, _ = inspect(folder().changed(change).write(tmp_path), ReportSettings())
    levels = report.value_at("streamed_sog.levels")
    full, small = (row[0] for row in COUNTS)
    assert small < 0.25 * (full + small)  # so that quartiles are those of the large region
    assert levels[0]["errors"] == dict.fromkeys(("min", "p25", "p50", "p75", "max", "mean"), 0.0)
    mean = (0.5 * full + 0.25 * small) / (full + small)
    expected = {"min": 0.25, "p25": 0.5, "p50": 0.5, "p75": 0.5, "max": 0.5, "mean": pytest.approx(mean, rel=1e-5)}
    assert levels[1]["errors"] == expected
    report, _ = inspect(folder(errors=False).write(tmp_path), ReportSettings())
    assert report.value_at("streamed_sog.levels.1.errors") is None


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("levels==3", True),
        ("levels>3", False),
        ("regions<=2", True),
        ("first_bytes<1MB", True),
        ("first_bytes<1kB", False),
        ("chunk_bytes<1kB", False),
        ("streamed_sog.levels.1.share<=50%", True),
        ("streamed_sog.levels.1.errors.max<=0.05", False),
        ("leaves>=229", True),
    ],
)
def test_expectations_hold_or_not(path: Path, text: str, holds: bool, capsys: Capture) -> None:
    assert run(["inspect", str(path), "--assert", text]) == (0 if holds else 3)
    assert ("expect." in capsys.readouterr().out) == (not holds)


@pytest.mark.parametrize(("name", "form"), [("levels", "Streamed SOG"), ("palette", "RAD")])
def test_other_formats_have_no_such_names(path: Path, name: str, form: str, capsys: Capture) -> None:
    other = path.parent / "0_0"
    assert run(["inspect", str(path if form == "RAD" else other), "--assert", f"{name}==1"]) == 3
    assert f"the file is not {form}" in capsys.readouterr().out


def test_headers_alone_tell_the_fields_of_the_manifest(path: Path, report: Report, capsys: Capture) -> None:
    assert run(["inspect", str(path.parent), "--field", "streamed_sog.levels.2.bytes"]) == 0
    assert json.loads(capsys.readouterr().out) == report.value_at("streamed_sog.levels.2.bytes")
    for field in ("bytes", "format", "splats", "sh_degree", "bytes_per_splat", "compression_ratio", "streamed_sog"):
        headers, _ = inspect(path, ReportSettings(headers_only=True))
        assert headers.value_at(field) == report.value_at(field)


def test_headers_alone_need_no_sound_images(tmp_path: Path) -> None:
    sound = folder()
    junk: dict[str, Any] = {name: b"x" * len(data) for name, data in sound.files.items() if name.endswith(".webp")}
    report, _ = inspect(sound.with_files(junk).write(tmp_path), ReportSettings(headers_only=True))
    assert report.value_at("streamed_sog.levels.0.splats") == sum(row[0] for row in COUNTS)


def test_a_person_reads_a_table_of_the_levels(path: Path, capsys: Capture) -> None:
    assert run(["inspect", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    (head,) = (number for number, line in enumerate(lines) if line.startswith("  levels "))
    assert lines[head].split() == [
        "levels",
        "splats",
        "share",
        "regions",
        "files",
        "size",
        "err.",
        "p25",
        "p50",
        "p75",
    ]
    assert lines[head + 2].split()[:5] == ["1", "18", "8.0", "%", "2"]
    assert "  environment 5 splats, " in "\n".join(lines)


def test_a_page_has_a_table_of_the_levels_and_escapes_names(tmp_path: Path) -> None:
    named = folder().having(asset={"generator": "<script>alert(1)</script>"})
    report, scene = inspect(named.write(tmp_path), ReportSettings(check=True, values=True))
    text = html.page([html.section_of(report, scene, None)])
    assert "Detail levels" in text and "Longest edge" in text
    assert "<script>" not in text


def test_a_manifest_that_is_too_large_is_refused(tmp_path: Path) -> None:
    path = Folder(folder().manifest | {"more": " " * MAX_MANIFEST}).write(tmp_path)
    (found,) = inspect(path, ReportSettings())[0].findings or []
    assert found.code == "container.corrupt"


def test_standard_input_has_no_chunk_files(path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    with path.open("rb") as file:
        monkeypatch.setattr("sys.stdin", type("Stdin", (), {"buffer": file, "isatty": lambda self: False})())
        assert run(["inspect", "-"]) == 1
    assert "standard input has no folder; give the path instead" in capsys.readouterr().err
