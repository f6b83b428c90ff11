"""Splats that no Gaussian is, such as those of a negative scale: refused, or left out and counted."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sparklod_cli as sparklod
from fixtures import by_hand_ksplat, by_hand_splat
from sparklod_cli.cli import run
from sparklod_cli.lod.tree_settings import METHODS
from sparklod_cli.model.scene import Scene
from sparklod_cli.model.selection import REASONS, Selection
from sparklod_cli.model.splats import INVALID, Splats
from sparklod_cli.system.errors import InvalidSplatsError
from tests.scenes import random_splats

pytestmark = pytest.mark.filterwarnings("error")

BAD = (7, 30)


def columns(value: float) -> dict[str, np.ndarray]:
    """50 splats as the writers of formats take them, two of them with this scale along one axis."""
    splats = random_splats(50, seed=2)
    scale = splats.scale.astype(np.float64)
    scale[BAD, (1, 2)] = value
    return {
        "center": splats.center.astype(np.float64),
        "scale": scale,
        "quat_wxyz": splats.quat_xyzw[:, [3, 0, 1, 2]].astype(np.float64),
        "opacity": splats.opacity.astype(np.float64),
        "rgb": splats.rgb.astype(np.float64),
        "sh": splats.sh.astype(np.float64),
    }


def ksplat(level: int) -> Callable[[float], bytes]:
    return lambda value: by_hand_ksplat.ksplat(**columns(value), level=level)


#: What writes each format that can hold a negative scale. The others hold logarithms.
WRITERS: dict[str, Callable[[float], bytes]] = {
    "a.splat": lambda value: by_hand_splat.splat(**columns(value)),
    "0.ksplat": ksplat(0),
    "1.ksplat": ksplat(1),
    "2.ksplat": ksplat(2),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("value", [-0.02, -60_000.0, -1e30])
@pytest.mark.parametrize("name", WRITERS)
def test_a_negative_scale_is_an_error_or_dropped(
    name: str, value: float, method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if name[0] in "12" and value < -65_504:
        pytest.skip("a half does not hold it")
    source, output = tmp_path / name, tmp_path / "out.spz"
    source.write_bytes(WRITERS[name](value))
    for command in (
        ["build-lod", str(source), "-o", str(output), "--method", method],
        ["convert", str(source), str(output), "--overwrite"],
    ):
        assert run(command) == 1
        (line,) = said(capfd)
        expected = (
            "2 of 50 splats are invalid (2 negative scale; the first is splat 7),"
            " add --on-invalid drop to leave them out"
        )
        assert line == f"error: {source}: {expected}"
        assert output.exists() == (command[0] == "convert")
        assert run([*command, "--on-invalid", "drop"]) == 0
        assert "  left out: 2 negative scale" in "".join(said(capfd))
        options = ["--leaves-of", str(source)] if command[0] == "build-lod" else []
        assert run(["inspect", "--check", *options, str(output)]) == 0
        capfd.readouterr()


def said(capfd: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Compiling")]


@pytest.mark.parametrize("name", WRITERS)
def test_inspect_names_a_negative_scale(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    source = tmp_path / name
    source.write_bytes(WRITERS[name](-0.02))
    assert run(["inspect", "--check", str(source)]) == 3
    out, err = capfd.readouterr()
    assert err == ""
    assert out == f"{source}: error: values.negative-scale: splat 7 and 1 more: a scale is below 0\n"
    assert run(["inspect", "--json", "--stats", str(source)]) == 0
    values = json.loads(capfd.readouterr().out)["values"]
    assert (values["non_finite"], values["negative_scale"]) == (0, 2)
    assert values["quantities"]["scale_min"]["min"] > 0  # without them


#: How to spoil a splat, by the kind that it then is of.
SPOILERS: dict[str, tuple[str, tuple[float, ...]]] = {
    "non_finite": ("rgb", (0.5, np.nan, 0.5)),
    "bad_rotation": ("quat_xyzw", (0.5, 0, 0, 0.5)),
    "negative_scale": ("scale", (0.1, -0.1, 0.1)),
    "negative_opacity": ("opacity", (-0.5,)),
}


def spoiled(kind: str, at: int, splats: Splats) -> Splats:
    name, value = SPOILERS[kind]
    column = getattr(splats, name).copy()
    column[at] = value if column.ndim > 1 else value[0]
    return dataclasses.replace(splats, **{name: column})


def test_every_kind_has_a_spoiler_and_is_a_reason() -> None:
    assert list(SPOILERS) == list(INVALID) == list(REASONS)[: len(INVALID)]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", INVALID)
def test_every_kind_is_refused_by_builders_and_dropped_by_a_selection(kind: str, method: str) -> None:
    good = random_splats(20, sh_degree=1)
    splats = spoiled(kind, 4, good)
    assert {each: mask.tolist() for each, mask in splats.invalid().items()} == {kind: [at == 4 for at in range(20)]}
    with pytest.raises(InvalidSplatsError, match=r"1 of 20 splats is .*the first is splat 4"):
        sparklod.build_lod(Scene(splats), method=method)
    with pytest.raises(InvalidSplatsError, match=r"1 of 20 splats is .*the first is splat 4"):
        Selection().apply(splats)
    kept, dropped = Selection(drop_invalid=True).apply(splats)
    assert dropped == {kind: 1}
    assert np.array_equal(kept.center, np.delete(good.center, 4, axis=0))


def test_a_splat_is_of_one_kind_and_the_first_of_all_is_named() -> None:
    splats = random_splats(20)
    for at, kind in enumerate(INVALID):
        splats = spoiled(kind, 10 - at, splats)
    splats = spoiled("negative_scale", 10, splats)  # which is not finite either
    assert {kind: int(mask.argmax()) for kind, mask in splats.invalid().items()} == dict(
        zip(INVALID, (10, 9, 8, 7), strict=True)
    )
    assert np.flatnonzero(~splats.is_valid()).tolist() == [7, 8, 9, 10]
    with pytest.raises(InvalidSplatsError) as raised:
        Selection().apply(splats)
    assert str(raised.value).startswith(
        "4 of 20 splats are invalid (1 not finite, 1 rotation not of length 1, 1 negative scale, 1 negative opacity;"
        " the first is splat 7), add"
    )


def test_scales_and_opacities_of_zero_and_minus_zero_are_valid() -> None:
    splats = random_splats(3)
    splats.scale[0] = splats.opacity[1] = -0.0
    splats.scale[2, 1] = -0.0
    assert splats.invalid() == {}
