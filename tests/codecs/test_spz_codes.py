"""What is counted and measured by the codes of an SPZ file: against numpy, on what they are decoded to."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from sparklod_cli.codecs.kernels import spz_codes
from sparklod_cli.codecs.spz_coded import CodedSpz
from sparklod_cli.codecs.spz_layout import HEADER, LOD, MAGIC, Layout
from sparklod_cli.io import read_coded
from sparklod_cli.model.gaussian import spark_size
from sparklod_cli.model.splats import COLUMNS

COUNT = 5_000
CODES = np.random.default_rng(3).integers(0, 256, (COUNT, 9), np.uint8)
CODES.flags.writeable = False  # as codes are that are read
#: Coordinates of the same bytes.
WHOLE = (
    CODES[:, 0::3].astype(np.int64) + (CODES[:, 1::3].astype(np.int64) << 8) + (CODES[:, 2::3].astype(np.int64) << 16)
)
POSITIONS = CODES.copy()
WHOLE = np.where(WHOLE >= 1 << 23, WHOLE - (1 << 24), WHOLE)


@pytest.fixture(scope="module", params=[0, LOD])
def coded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> CodedSpz:
    """A file of any codes, without a tree and with one of a single node beside others that it does not lead to."""
    layout, rng = Layout(3, COUNT, 1, 12, request.param), np.random.default_rng(5)
    data = HEADER.pack(MAGIC, 3, COUNT, 1, 12, request.param, 0)
    for stream in layout.streams():
        most = 1 if stream.name.startswith("child") else 256
        data += rng.integers(0, most, (COUNT, stream.size), np.uint8).tobytes()
    path: Path = tmp_path_factory.mktemp("codes") / "any.spz"
    path.write_bytes(gzip.compress(data, 1))
    found = read_coded(path)
    assert found is not None
    return found


def test_bytes_are_counted_by_column() -> None:
    counts = np.zeros((9, 256), np.int64)
    spz_codes.count_bytes(CODES, counts)
    assert np.array_equal(counts, [np.bincount(column, minlength=256) for column in CODES.T])


def test_the_largest_and_the_smallest_byte_are_counted() -> None:
    codes, counts, expected = CODES[:, :3].copy(), np.zeros((256, 256), np.int64), np.zeros((256, 256), np.int64)
    spz_codes.count_ends(codes, counts)
    np.add.at(expected, (codes.max(axis=1), codes.min(axis=1)), 1)
    assert np.array_equal(counts, expected)


@pytest.mark.parametrize(("first", "last"), [(0, 9), (3, 5), (8, 9)])
def test_squares_are_counted_by_their_sum(first: int, last: int) -> None:
    sums = ((CODES[:, first:last].astype(np.int64) - 128) ** 2).sum(axis=1)
    counts = np.zeros(128**2 * (last - first) + 1, np.int64)
    spz_codes.count_squares(CODES, first, last, counts)
    assert np.array_equal(counts, np.bincount(sums, minlength=len(counts)))


def test_the_largest_sum_of_squares_has_a_place() -> None:
    counts, zeros = np.zeros(128**2 * 9 + 1, np.int64), np.frombuffer(bytes(18), np.uint8).reshape(2, 9)
    spz_codes.count_squares(zeros, 0, 9, counts)
    assert counts[-1] == 2


@pytest.mark.parametrize("axis", range(3))
def test_halves_of_coordinates_are_counted(axis: int) -> None:
    keys, half = WHOLE[:, axis] + (1 << 23), 1 << 12
    upper = np.zeros((1, half), np.int64)
    assert spz_codes.count_halves(POSITIONS, axis, 12, np.zeros(half, np.int16), upper) == WHOLE[:, axis].sum()
    assert np.array_equal(upper[0], np.bincount(keys >> 12, minlength=half))
    wanted = np.unique(keys >> 12)[[3, 100]]
    rows, lower = np.full(half, -1, np.int16), np.zeros((2, half), np.int64)
    rows[wanted] = 0, 1
    spz_codes.count_halves(POSITIONS, axis, 0, rows, lower)
    for row, prefix in zip(lower, wanted, strict=True):
        assert np.array_equal(row, np.bincount(keys[keys >> 12 == prefix] & (half - 1), minlength=half))


def test_columns_by_tables_are_those_of_the_streams(coded: CodedSpz) -> None:
    splats, _ = coded.decode(slice(7, 3_000))
    for stream in coded.layout.streams():
        if stream.column in COLUMNS:
            expected = stream.decode(coded.codes[stream.name][7:3_000])
            assert np.array_equal(getattr(splats, stream.column).ravel(), expected.ravel())


def test_sizes_and_extremes_are_those_of_the_splats(coded: CodedSpz) -> None:
    part = slice(11, 4_000)
    splats, _ = coded.decode(part)
    size = np.empty(len(splats), np.float32)
    coded.fill_sizes(part, size)
    assert np.array_equal(size, spark_size(splats))
    opacity, largest, furthest = coded.extremes(part)
    assert np.array_equal(opacity, splats.opacity)
    assert np.array_equal(largest, splats.scale.max(axis=1))
    assert np.array_equal(furthest, np.abs(splats.center).max(axis=1))
