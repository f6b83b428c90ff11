"""Pictures of a path: each is drawn once, whatever is found out before, and comes out the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparklod_cli.cameras.camera import Settings
from sparklod_cli.cameras.sources import CameraPath, single_views
from sparklod_cli.images import sequence
from sparklod_cli.images.output import output_for
from sparklod_cli.images.sequence import PictureSettings, WrittenPictures, write_pictures
from sparklod_cli.model.instances import instances_of
from sparklod_cli.render.renderer import DrawnPicture, Renderer
from sparklod_cli.render.settings import RenderSettings
from sparklod_cli.viewers.scenes import CutFinder, read_scenes
from sparklod_cli.viewers.viewer_settings import LodSettings
from tests.conftest import FIXTURES

TOWN = FIXTURES / "traverse" / "town.spz"


def path_of(count: int) -> CameraPath:
    views = [((float(number), -3.0, 9.0), (0.0, 0.0, 0.0)) for number in range(count)]
    return single_views(views, Settings(size=(48, 32)))


def written(folder: Path, count: int, budget: int = 900) -> WrittenPictures:
    """Differences of cuts of a budget from others of 3000."""
    scenes = read_scenes(instances_of([TOWN]))
    finders = [CutFinder(scenes, LodSettings(each)) for each in (budget, 3000)]
    return write_pictures(
        finders[0],
        path_of(count),
        output_for(folder / "x.%d.png", Path("x"), count, sheet=False),
        RenderSettings(),
        PictureSettings(background=(0.0, 0.0, 0.0)),
        reference=finders[1],
    )


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_difference_draws_every_picture_once(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    draw = Renderer.draw

    def counted(self: Renderer, camera: object) -> DrawnPicture:
        drawn.append(camera)
        return draw(self, camera)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "draw", counted)
    pictures = written(tmp_path, count)
    assert len(drawn) == 2 * count
    assert pictures.gain is not None and pictures.gain > 1
    assert len(pictures.frames) == count
    assert pictures.bytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    assert not pictures.empty


def test_pictures_too_large_to_keep_come_out_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = [tmp_path / name for name in ("kept", "drawn-again")]
    for folder, pixels in zip(folders, (sequence.CACHED_PIXELS, 0), strict=True):
        folder.mkdir()
        monkeypatch.setattr(sequence, "CACHED_PIXELS", pixels)
        written(folder, 3)
    one, other = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in folders)
    assert one == other
    assert len(one) == 3


def test_progress_tells_of_the_cuts_that_colours_are_found_with(tmp_path: Path) -> None:
    told: list[tuple[str, int, int, str]] = []
    finder = CutFinder(read_scenes(instances_of([TOWN])), LodSettings(900))
    output = output_for(tmp_path / "x.%d.png", Path("x"), 40, sheet=False)
    write_pictures(
        finder,
        path_of(40),
        output,
        RenderSettings(color_by="level"),
        PictureSettings(),
        progress=lambda *each: told.append(each),
    )
    colours = [each for each in told if each[0] == "colours"]
    assert [each[1:] for each in colours] == [(number, 14, "cut") for number in range(1, 15)]
    assert told[-1] == ("drawing", 40, 40, "frame")


@pytest.mark.parametrize("name", ["x.gif", "x.webp"])
def test_an_interrupted_animation_leaves_nothing_and_what_was_there(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(b"before")
    draw, drawn = Renderer.draw, []

    def interrupted(self: Renderer, camera: object) -> DrawnPicture:
        drawn.append(camera)
        if len(drawn) == 30:
            raise KeyboardInterrupt
        return draw(self, camera)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "draw", interrupted)
    finder = CutFinder(read_scenes(instances_of([TOWN])), LodSettings(900))
    output = output_for(tmp_path / name, Path("x"), 40, sheet=False)
    with pytest.raises(KeyboardInterrupt):
        write_pictures(finder, path_of(40), output, RenderSettings(), PictureSettings(jobs=1), overwrite=True)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"before"]


@pytest.mark.parametrize("name", ["x.gif", "x.webp"])
def test_an_animation_is_written_while_frames_are_drawn(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No more frames wait than are encoded together."""
    events: list[str] = []
    draw, animate = Renderer.draw, sequence.animate

    def drawn(self: Renderer, camera: object) -> DrawnPicture:
        events.append("draw")
        return draw(self, camera)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "draw", drawn)
    monkeypatch.setattr(
        sequence, "animate", lambda frames, *rest: animate((events.append("taken") or each for each in frames), *rest)
    )
    finder = CutFinder(read_scenes(instances_of([TOWN])), LodSettings(900))
    output = output_for(tmp_path / name, Path("x"), 40, sheet=False)
    write_pictures(finder, path_of(40), output, RenderSettings(), PictureSettings(jobs=1))
    ahead = [events[:at].count("draw") - events[:at].count("taken") for at in range(len(events))]
    assert events.count("taken") == 40 and max(ahead) <= 3
