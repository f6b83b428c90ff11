"""Progress, threads and notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import sparklod_cli as sparklod
from tests.api.runs import camera


def test_progress_is_told_to_a_function_and_to_bars(scene: sparklod.Scene) -> None:
    told: list[tuple[str, int, int]] = []
    sparklod.build_lod(scene, progress=lambda stage, done, total, unit: told.append((stage, done, total)))
    assert told and all(0 <= done <= total for _, done, total in told)

    bars: list[Bar] = []

    class Bar:
        def __init__(self, **how: Any) -> None:
            self.n, self.total, self.stage, self.closed = 0, how["total"], how["desc"], False
            bars.append(self)

        def update(self, more: int) -> None:
            self.n += more

        def close(self) -> None:
            self.closed = True

    sparklod.build_lod(scene, progress=Bar)
    assert [bar.stage for bar in bars] == list(dict.fromkeys(stage for stage, *_ in told))
    assert all(bar.closed and bar.n == bar.total for bar in bars)


def test_work_is_done_on_the_threads_that_are_asked_for(
    scene: sparklod.Scene, held: sparklod.Tree, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparklod_cli.render import rasterizer
    from sparklod_cli.system.threads import threads_in_use

    before, used = threads_in_use(), set()
    draw = rasterizer.draw

    def noted(*arguments: Any) -> Any:
        used.add(threads_in_use())
        return draw(*arguments)

    monkeypatch.setattr(rasterizer, "draw", noted)
    sparklod.render(scene, camera(), threads=1)
    sparklod.compare(held, None, [camera()], budgets=[50, 0.5], threads=1)
    assert used == {1}
    sparklod.build_lod(scene, threads=1)
    assert threads_in_use() == before


def test_notebooks_show_pictures_and_tables(held: sparklod.Tree, tmp_path: Path) -> None:
    picture = sparklod.show(sparklod.render(held, camera()))
    assert picture._repr_png_().startswith(b"\x89PNG")
    picture.save(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes() == picture.png
    frames = sparklod.traverse(held, [camera()] * 30, budget=300)
    html = frames._repr_html_()
    assert html.count("<tr>") == 1 + 20 + 1 and "…" in html
    assert repr(frames) in html
