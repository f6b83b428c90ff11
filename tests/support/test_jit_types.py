"""The types of kernels' arguments."""

from __future__ import annotations

import itertools
from collections import namedtuple
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from sparklod_cli.support.jit_types import Type, b1, describe, example, f4, fields, fits, i8, key_of, out, u2, u4

Pair = namedtuple("Pair", "first second")
Other = namedtuple("Other", "first second")

RECORD = np.dtype([("a", "<f4"), ("b", "<i8", (3,))])
ALIGNED = np.dtype([("a", "<f4"), ("b", "<i8", (3,))], align=True)


def readonly(values: Any) -> Any:
    values.flags.writeable = False
    return values


#: Arguments of kernels, all combinations of which are compared.
VALUES: list[Any] = [
    *(True, np.True_, 0, -1, 1 << 40, np.int64(1), np.int32(1), np.uint8(3), np.uint64(1), np.longlong(1)),
    *(1.5, np.float64(1.5), np.float32(1.5), None),
    *(np.zeros(3, code) for code in ("f4", "f8", "i4", "i8", "u1", "u2", "u4", "u8", "?", np.longlong)),
    *(np.zeros(0, "f4"), np.zeros((2, 3), "f4"), np.zeros((1, 3), "f4"), np.zeros((2, 3), "f4").T),
    np.zeros(6, "f4")[::2],
    *(np.zeros((2, 3, 4), "f4"), np.zeros((4, 4), "f4")[:, :2], np.zeros((), "f4"), readonly(np.zeros(3, "f4"))),
    *(readonly(np.zeros((2, 3), "f4").T), np.zeros(2, RECORD), np.zeros(2, ALIGNED), np.zeros(2, RECORD)["a"]),
    *((), (1, 2), (1, 2.0), (1, 2, 3), ((1, 2), 3), Pair(1, 2), Other(1, 2), Pair(1.0, 2), Pair(np.zeros(3), (1, 2))),
    (1, np.zeros(3)),
]  # fmt: skip


def test_texts_and_keys_tell_types_apart_as_numba_does() -> None:
    numbas = [numba.typeof(value) for value in VALUES]
    keys, texts = [key_of([value]) for value in VALUES], [describe([value]) for value in VALUES]
    assert None not in keys
    assert None not in texts
    for one, other in itertools.combinations(range(len(VALUES)), 2):
        assert (texts[one] == texts[other]) == (numbas[one] == numbas[other]), (VALUES[one], VALUES[other])
        assert numbas[one] == numbas[other] or keys[one] != keys[other], (VALUES[one], VALUES[other])


def test_the_order_and_the_grouping_of_arguments_count() -> None:
    arguments: list[Any] = [(1, 2.0), (2.0, 1), ((1, 2.0),), ((1,), 2.0), (1,), ()]
    assert len({key_of(each) for each in arguments}) == len({describe(each) for each in arguments}) == len(arguments)


@fields(f4[:, :], out(i8[:]), b1)
class Columns(NamedTuple):
    first: Any
    second: Any
    third: Any


def test_examples_are_of_the_declared_types() -> None:
    declared = [u4, f4[:], f4[:, :, :], out(u2[:]), Columns, out(Columns), Type(RECORD)[:]]
    writeable, frozen = np.zeros((1, 1), "f4"), readonly(np.zeros((1, 1), "f4"))
    expected = [
        *(np.uint32(1), readonly(np.zeros(3, "f4")), readonly(np.zeros((1, 2, 3), "f4")), np.zeros(2, "u2")),
        *(Columns(frozen, np.zeros(1, "i8"), True), Columns(writeable, np.zeros(1, "i8"), False)),
        readonly(np.zeros(2, RECORD)),
    ]
    assert describe(map(example, declared)) == describe(expected)


def test_only_arrays_that_are_read_may_be_read_only_or_not() -> None:
    values, frozen = np.zeros((2, 3), "f4"), readonly(np.zeros((2, 3), "f4"))
    texts = {name: str(describe([value, 1])) for name, value in {"values": values, "frozen": frozen}.items()}
    assert fits(texts["values"], texts["frozen"])
    assert fits(texts["frozen"], texts["frozen"])
    assert not fits(texts["frozen"], texts["values"])
    assert not fits(str(describe([values])), texts["frozen"])
    for one, other in itertools.product(VALUES, VALUES):
        same = str(describe([one])).replace(" readonly", "") == str(describe([other])).replace(" readonly", "")
        assert same or not fits(str(describe([one])), str(describe([other])))


@pytest.mark.parametrize(
    "value",
    [1j, "text", b"bytes", [1], {1}, 1 << 63, object(), np.ma.zeros(3), np.void(b"x"), (1, "text"), np.float16(1)],
)
def test_what_kernels_do_not_take_is_left_to_numba(value: Any) -> None:
    assert key_of([1, value]) is None
    assert describe([1, value]) is None


@pytest.mark.parametrize("dtype", [">f4", "S3", "U3", "M8[s]", "c8", "O", [("a", ">f4")], [("a", "<f4"), ("b", "U2")]])
def test_arrays_of_other_types_are_left_to_numba(dtype: Any) -> None:
    assert describe([np.zeros(3, dtype)]) is None


def test_a_mapped_file_is_an_array(tmp_path: Any) -> None:
    mapped = np.memmap(tmp_path / "rows", np.float32, "w+", shape=(4, 3))
    assert key_of([mapped]) == key_of([np.zeros((4, 3), np.float32)])
    assert describe([mapped]) == describe([np.zeros((4, 3), np.float32)])
    assert numba.typeof(mapped) == numba.typeof(np.zeros((4, 3), np.float32))
