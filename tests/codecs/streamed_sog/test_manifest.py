"""The manifest of Streamed SOG: what is parsed, what is refused and where, and numbers that are rounded outward."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparklod_cli.codecs import streamed_manifest as manifests
from sparklod_cli.codecs.formats import is_of_streamed_sog
from sparklod_cli.codecs.streamed_manifest import LARGEST, Manifest, ManifestNode, Run, parse, serialise
from sparklod_cli.system.errors import FormatError, VersionError

BOUND = {"min": [-1, 0, 0.5], "max": [1, 2, 3e5]}
LEAF = {"bound": BOUND, "lods": {"0": {"file": 0, "offset": 0, "count": 3}, "1": {"file": 1, "offset": 4, "count": 2}}}
TREE = {"bound": BOUND, "children": [LEAF, {"bound": BOUND, "children": [LEAF, LEAF]}]}
META = {"version": 1, "lodLevels": 2, "filenames": ["0_0/meta.json", "1_0/meta.json"], "tree": TREE}


def parsed(**changes: Any) -> Manifest:
    """What is parsed of `META` with changes; `...` leaves a key out."""
    return parse(json.dumps({key: value for key, value in (META | changes).items() if value is not ...}).encode())


def leaf(**changes: Any) -> dict[str, Any]:
    return {"bound": BOUND, "lods": {"1": {"file": 0, "offset": 0, "count": 3} | changes}}


def test_nodes_are_in_the_order_of_the_file_root_first() -> None:
    manifest = parsed(environment="env/meta.json", count=7)
    assert [node.children for node in manifest.nodes] == [(1, 2), (), (3, 4), (), ()]
    assert [node.parent for node in manifest.nodes] == [-1, 0, 0, 2, 2]
    assert manifest.place(0) == "tree"
    assert manifest.place(4) == "tree.children[1].children[1]"
    assert [number for number, _ in manifest.regions()] == [1, 3, 4]
    assert manifest.nodes[1] == ManifestNode(
        ((-1, 0, 0.5), (1, 2, 3e5)), (), {0: Run(0, 0, 3), 1: Run(1, 4, 2)}, None, 0
    )
    assert manifest.names() == ["0_0/meta.json", "1_0/meta.json", "env/meta.json"]
    assert manifest.head == {"version": 1, "count": 7}


def test_what_only_breaks_rules_is_kept_for_a_report() -> None:
    broken = {"children": [leaf() | {"errors": "none", "bound": {"min": [0, 1]}}, {}, {"lods": {}}]}
    manifest = parsed(tree=broken, version=..., counts="many", lodErrors=3)
    assert [node.bound for node in manifest.nodes] == [None] * 4
    assert [node.errors for node in manifest.nodes] == [None, "none", None, None]
    assert [node.runs for node in manifest.nodes] == [None, {1: Run(0, 0, 3)}, None, {}]
    assert manifest.head == {"counts": "many", "lodErrors": 3}


@pytest.mark.parametrize(
    "bound",
    [None, [], {"min": [0, 0, 0]}, {"min": [0, 0], "max": [1, 1, 1, 1]}, {"min": [0, 0, True], "max": [1, 1, 1]}]
    + [{"min": [0, 0, 0], "max": [1, 1, number]} for number in (math.nan, math.inf, "1", None, [])],
)
def test_a_bound_that_is_not_of_six_finite_numbers_is_none(bound: Any) -> None:
    assert parsed(tree=leaf() | {"bound": bound}).nodes[0].bound is None


LEVELS, SPLATS = "expected a whole number from 1 to 32", "expected a whole number from 0 to 268,435,456"
REFUSED = [
    ({"lodLevels": ...}, f"lodLevels of lod-meta.json: {LEVELS}, but it is missing"),
    ({"lodLevels": 0}, f"lodLevels of lod-meta.json: {LEVELS}, not 0"),
    ({"lodLevels": 1e9}, f"lodLevels of lod-meta.json: {LEVELS}, not 1000000000.0"),
    ({"lodLevels": True}, f"lodLevels of lod-meta.json: {LEVELS}, not True"),
    ({"filenames": "x"}, "filenames of lod-meta.json: expected a list, not 'x'"),
    ({"filenames": [1]}, "filenames[0] of lod-meta.json: expected a text, not 1"),
    ({"environment": 7}, "environment of lod-meta.json: expected a text, not 7"),
    ({"tree": ...}, "tree of lod-meta.json: expected an object, but it is missing"),
    ({"tree": []}, "tree of lod-meta.json: expected an object, not []"),
    ({"tree": {"children": 5}}, "tree.children of lod-meta.json: expected a list, not 5"),
    ({"tree": {"children": 0}}, "tree.children of lod-meta.json: expected a list, not 0"),
    ({"tree": {"children": [LEAF, 5]}}, "tree.children[1] of lod-meta.json: expected an object, not 5"),
    (
        {"tree": {"children": [LEAF, {"children": [LEAF, {"lods": 1}]}]}},
        "tree.children[1].children[1].lods of lod-meta.json: expected an object, not 1",
    ),
    ({"tree": {"lods": {"2": {}}}}, "tree.lods.2 of lod-meta.json: there is no such level, only 0 to 1"),
    ({"tree": {"lods": {"01": {}}}}, "tree.lods.01 of lod-meta.json: there is no such level, only 0 to 1"),
    ({"tree": {"lods": {"1": 3}}}, "tree.lods.1 of lod-meta.json: expected an object, not 3"),
    ({"tree": leaf(file=2)}, "tree.lods.1.file of lod-meta.json: expected a whole number from 0 to 1, not 2"),
    ({"tree": leaf(file=None)}, "tree.lods.1.file of lod-meta.json: expected a whole number from 0 to 1, but it is"),
    ({"tree": leaf(offset=-1)}, f"tree.lods.1.offset of lod-meta.json: {SPLATS}, not -1"),
    ({"tree": leaf(count=1.5)}, f"tree.lods.1.count of lod-meta.json: {SPLATS}, not 1.5"),
    ({"tree": leaf(count=2**40)}, f"tree.lods.1.count of lod-meta.json: {SPLATS}, not {2**40}"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_what_reading_needs_is_refused_with_value_and_place(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FormatError) as raised:
        parsed(**changes)
    assert str(raised.value).startswith(message)


@pytest.mark.parametrize("version", [0, 2, "1", 1.0, True])
def test_another_version_is_refused(version: Any) -> None:
    with pytest.raises(VersionError, match=r"Streamed SOG version .* is unknown, only 1 is read"):
        parsed(version=version)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"null", b'"lodLevels"', b"\xff"])
def test_what_is_no_json_object_is_refused(data: bytes) -> None:
    with pytest.raises(FormatError, match=r"lod-meta\.json(: expected an object, | is not JSON)"):
        parse(data)


def chain(depth: int) -> bytes:
    """A manifest whose tree is a chain."""
    beginning = b'{"lodLevels":1,"filenames":[],"tree":'
    return beginning + b'{"children":[' * depth + b'{"lods":{}}' + b"]}" * depth + b"}"


def test_a_deep_tree_is_parsed_and_written() -> None:
    manifest = parse(chain(250))
    assert len(manifest.nodes) == 251
    assert manifest.place(250) == "tree" + ".children[0]" * 250
    assert parse(serialise(manifest)) == manifest


@pytest.mark.parametrize("depth", [300, 5_000, 100_000])
def test_a_tree_of_no_end_is_refused(depth: int) -> None:
    with pytest.raises(FormatError, match="nested more than 512 deep"):
        parse(chain(depth))


def test_a_tree_of_too_many_nodes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifests, "MAX_NODES", 5)
    assert len(parsed().nodes) == 5
    with pytest.raises(FormatError, match="more than 5 nodes"):
        parsed(tree={"children": [TREE, LEAF]})


def test_a_manifest_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifests, "MAX_MANIFEST", 100)
    with pytest.raises(FormatError, match="more than 100 bytes"):
        parsed()


@pytest.mark.parametrize("changes", [{}, {"environment": "env/meta.json", "lodErrors": True, "count": 3}])
def test_what_is_written_is_parsed_again(changes: dict[str, Any]) -> None:
    manifest = parsed(**changes)
    assert parse(serialise(manifest)) == manifest


@given(st.floats(-LARGEST, LARGEST), st.floats(-1e9, 1e9))
def test_bounds_are_rounded_outward_to_7_digits(low: float, high: float) -> None:
    manifest = Manifest(1, (), (ManifestNode(((low, low, low), (high, high, high)), (), {}),))
    bound = parse(serialise(manifest)).nodes[0].bound
    assert bound is not None  # also at the end of float32
    (found_low, _, _), (found_high, _, _) = bound
    assert low - 1e-6 * abs(low) - 1e-320 <= found_low <= low
    assert high <= found_high <= high + 1e-6 * abs(high) + 1e-320
    assert parse(serialise(Manifest(1, (), (ManifestNode(bound, (), {}),)))).nodes[0].bound == bound


@pytest.mark.parametrize("name", ["0_0/meta.json", "12_345/means_l.webp", "env/env.sog", "env/meta.json"])
def test_names_of_an_output(name: str) -> None:
    assert is_of_streamed_sog(name)


@pytest.mark.parametrize(
    "name",
    [
        "meta.json",
        "00_0/meta.json",
        "env.sog",
        "0_0/env.sog",
        "0_0/x.webp",
        "0_0/",
        "0_0/../meta.json",
        "x/meta.json",
        "0_0/0_0/meta.json",
    ],
)
def test_other_names_are_not_of_an_output(name: str) -> None:
    assert not is_of_streamed_sog(name)
