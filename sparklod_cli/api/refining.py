"""Fitting the merged splats of a tree to pictures of full detail."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from ..bake.refining import Refined, refined
from ..cameras.camera import Camera
from ..cameras.path import CameraPath
from ..fitting.settings import MOST_SEED, MOST_STEPS, FitSettings
from ..model.scene import Scene, Tree
from ..support.errors import FormatError, memory_errors_translated
from ..support.parallel import thread_count
from ..support.progress import Progress
from .arguments import path_like, scene_like, whole_within
from .progress import Told, telling


def refine(
    tree: Scene,
    *,
    steps: int | None = None,
    seed: int = 0,
    cameras: CameraPath | Iterable[Camera] | None = None,
    threads: int | None = None,
    progress: Told = None,
    say: Callable[[str], None] | None = None,
) -> tuple[Tree, Refined]:
    """Fits the merged splats of a tree to pictures of full detail, as `build-lod --refine` does.

    The links of the tree, the order of its nodes and its leaves stay as they are, bit for bit. The same tree and
    arguments give the same result for any number of threads.

    Args:
        tree: of any builder, or read from a file.
        steps: pictures of cuts that are drawn and compared; None for a number that suits the size of the tree.
        seed: of the cameras and budgets that are drawn at random.
        cameras: those for which it is fitted; None for cameras around and inside the scene.
        threads: to work on; None for all processors.
        progress: called with how much is done.
        say: called with a line of text after each stage.

    Returns:
        the tree, and what the fitting brought on held-out cameras.

    Raises:
        FormatError: the scene has no tree.
        InvalidSplatsError: a node has numbers that no splat has.
        ValueError: a number is out of its range, or there are no cameras.
        OutOfMemoryError: it does not fit into memory.
    """
    if scene_like(tree).tree is None:
        raise FormatError("the scene has no Level-of-Detail tree; build_lod makes one")
    settings = checked(FitSettings(steps, seed, None if cameras is None else path_like(cameras)))
    with telling(progress) as told, memory_errors_translated():
        return refined_tree(tree, settings, thread_count(threads), told, say)


def asked_for(refine: bool | int | FitSettings) -> FitSettings | None:
    """The settings that an argument `refine` stands for; None for not at all.

    Raises:
        TypeError, ValueError: it stands for none.
    """
    if isinstance(refine, bool):
        return FitSettings() if refine else None
    if isinstance(refine, FitSettings):
        return checked(refine)
    whole_within("refine", refine, 1, MOST_STEPS)
    return FitSettings(steps=int(refine))


def checked(settings: FitSettings) -> FitSettings:
    """Settings whose numbers are in their ranges; `ValueError` or `TypeError` otherwise."""
    if settings.steps is not None:
        whole_within("steps", settings.steps, 1, MOST_STEPS)
    whole_within("seed", settings.seed, 0, MOST_SEED)
    return settings


def refined_tree(
    tree: Scene, settings: FitSettings, threads: int, progress: Progress, say: Callable[[str], None] | None
) -> tuple[Tree, Refined]:
    """A tree whose merged splats are fitted, and what that brought."""
    found, report = refined(tree, settings, threads=threads, progress=progress, say=say or (lambda text: None))
    assert found.tree is not None
    return Tree(found.splats, found.tree, found.antialiased, up=found.up), report
