"""Which inputs that have a tree are written in another format with that tree."""

from __future__ import annotations

from ..codecs.file_names import RAD_SUFFIX as RAD
from ..codecs.formats import WRITABLE
from ..model.scene import Scene
from ..support.errors import FormatError
from .settings import SPZ, BakeSettings


def check_kept(scene: Scene, settings: BakeSettings) -> None:
    """Checks that a scene that has a tree can be written with it.

    Raises:
        FormatError: nobody asked for another format than that of the scene, or for merged splats to be fitted; or for
            something that only splats without a tree can be given.
    """
    held = scene.format.split()[0]
    converts = settings.converts and settings.encoding is None and not _is_same(scene, held, settings)
    if settings.refine is None and not converts:
        other = next(each for each in (WRITABLE[RAD], WRITABLE[SPZ]) if each.name != held)
        raise FormatError(
            "it is a Level-of-Detail file already; --unlod writes its splats back out, and --format"
            f" {other.suffixes[0][1:]} its tree as {other.name}; --refine fits its merged splats"
        )
    if settings.unused:
        kept = "is written as it is" if settings.refine is None else "--refine keeps"
        raise FormatError(
            f"it has a tree, which {kept}; leave out {', '.join(settings.unused)}, or give the splats that"
            " the tree was built from"
        )


def has_format_of(scene: Scene, settings: BakeSettings) -> bool:
    """Whether the format that is written is that of the scene, in one file or in several."""
    return settings.detail is None and settings.encoding is None and _written(settings) == scene.format.split()[0]


def _is_same(scene: Scene, held: str, settings: BakeSettings) -> bool:
    """Whether the format that is written is that of the scene."""
    if settings.detail is not None:
        return False
    chunked = bool(scene.header.get("chunked"))
    return held == _written(settings) and chunked == settings.options.rad.chunked


def _written(settings: BakeSettings) -> str:
    return WRITABLE[settings.suffix].name
