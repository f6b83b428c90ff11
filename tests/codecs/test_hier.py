"""Hierarchies: which of their splats are full detail, and what is refused."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable

import numpy as np
import pytest

from fixtures import by_hand_hier
from sparklod_cli.codecs import hier
from sparklod_cli.codecs.formats import sniff
from sparklod_cli.codecs.reader import decode_file
from sparklod_cli.model.scene import Scene
from sparklod_cli.system.errors import FormatError, TruncatedError
from tests.codecs.cases import linear
from tests.scenes import random_splats

SCENE = Scene(random_splats(10, sh_degree=1))
#: Ten splats below three nodes and a root; the positions of the numbers of splats and of nodes.
DATA, SPLATS, NODES = by_hand_hier.hier(**linear(SCENE)), 14, 4 + 14 * 236
#: Numbers of a node.
DEPTH, PARENT, START, LEAVES, MERGED, FIRST_CHILD, CHILDREN = range(7)


def decode(data: bytes) -> Scene:
    scene: Scene = decode_file(hier, io.BytesIO(data))
    return scene


def changed(*changes: tuple[int, int, int], data: bytes = DATA) -> bytes:
    """Changes numbers of nodes, each by node, number and value."""
    new = bytearray(data)
    for node, number, value in changes:
        struct.pack_into("<i", new, NODES + 4 + 28 * node + 4 * number, value)
    return bytes(new)


def test_full_detail_is_the_leaves_in_the_order_of_the_file() -> None:
    np.testing.assert_array_equal(decode(DATA).splats.center, SCENE.splats.center)


def test_a_node_without_children_stands_for_them() -> None:
    """As in hierarchies that were cut to a chunk; the splats of its former children are still in the file."""
    lost = [(node, LEAVES, 0) for node in (12, 13)]  # the splats of the last inner node
    centers = decode(changed((3, CHILDREN, 0), *lost)).splats.center
    np.testing.assert_array_equal(centers[:8], SCENE.splats.center[:8])
    np.testing.assert_allclose(centers[8], SCENE.splats.center[8:].mean(axis=0), rtol=1e-5)
    assert len(centers) == 9


def test_a_node_may_have_splats_of_its_own() -> None:
    first_two = [(4, LEAVES, 2), (5, LEAVES, 0)]
    np.testing.assert_array_equal(decode(changed(*first_two)).splats.center, SCENE.splats.center)


def test_opacities_above_one_are_one() -> None:
    columns = linear(SCENE) | {"opacity": np.linspace(0.5, 1.4, 10)}
    opacity = decode(by_hand_hier.hier(**columns)).splats.opacity
    np.testing.assert_allclose(opacity, np.minimum(columns["opacity"], 1), rtol=1e-6)


REFUSED: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "cut short"),
    "more splats than bytes": (lambda: struct.pack("<i", 2**31 - 1) + DATA[4:], "fewer splats than it announces"),
    "more halves than bytes": (lambda: struct.pack("<i", -(2**31)) + DATA[4:], "fewer splats than it announces"),
    "more nodes than bytes": (
        lambda: DATA[:NODES] + struct.pack("<i", 2**31 - 1) + DATA[NODES + 4 :],
        "14 splats in 2,147,483,647 nodes",
    ),
    "fewer nodes than none": (lambda: DATA[:NODES] + struct.pack("<i", -1) + DATA[NODES + 4 :], "in -1 nodes"),
    "a run past the end": (lambda: changed((13, START, SPLATS)), "does not have"),
    "a run before the beginning": (lambda: changed((4, START, -1)), "does not have"),
    "a negative number": (lambda: changed((4, LEAVES, -1)), "does not have"),
    "children past the end": (lambda: changed((0, FIRST_CHILD, 12)), "does not have"),
    "a child that is the root": (lambda: changed((1, FIRST_CHILD, 0)), "does not have"),
    "the same splats twice": (lambda: changed((5, START, 2)), "name the same splats"),
    "all splats for each node": (
        lambda: changed(*((node, number, value) for node in range(14) for number, value in ((START, 0), (LEAVES, 14)))),
        "does not have|name the same splats",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_broken_hierarchies_are_refused_with_a_reason(what: str) -> None:
    make, reason = REFUSED[what]
    with pytest.raises(FormatError, match=reason):
        decode(make())


@pytest.mark.parametrize("half", [False, True])
def test_a_byte_less_is_cut_short(half: bool) -> None:
    with pytest.raises(TruncatedError):
        decode(by_hand_hier.hier(**linear(SCENE), half=half)[:-1])


def test_bytes_after_the_boxes_are_counted() -> None:
    assert decode(DATA + b"more").header["trailing_bytes"] == 4


@pytest.mark.parametrize("count", [256, 1024, 65_280])
def test_a_number_of_splats_is_no_magic(count: int) -> None:
    """Such a number begins as a KSPLAT does."""
    form = sniff(struct.pack("<i3f", count, 0.5, 1, 2), ".hier")
    assert form is not None and form.name == "HIER"
