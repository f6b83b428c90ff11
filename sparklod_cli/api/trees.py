"""Trees of scenes: build, simplify, fit, arrange, take the leaves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

from ..bake.built_tree import build_tree, select
from ..bake.settings import BakeSettings
from ..bake.simplifying import SimplifyGoal, leaves_of, refined, simplified
from ..cameras.camera import Camera
from ..cameras.sources import CameraPath
from ..codecs.reader import check_valid
from ..fitting import STEPS
from ..fitting.fit_settings import FitSettings, Refined
from ..lod.tree_settings import (
    BUILDERS,
    DEFAULT_BASE,
    DEFAULT_GROWTH,
    DETAIL_GROWTH,
    MAX_BASE,
    MAX_GROWTH,
    METHODS,
    MIN_BASE,
    MIN_GROWTH,
)
from ..model import MAX_SH_DEGREE
from ..model.scene import Scene
from ..model.selection import Selection
from ..system.errors import FormatError, memory_errors_translated
from ..system.progress import Progress
from ..system.setting_fields import Range, whole
from ..system.threads import on_threads, thread_count
from .arguments import BudgetLike, ProgressLike, budget_like, path_like, progress_callback, scene_like
from .splat_files import Tree


def build_lod(
    scene: Scene,
    *,
    method: str = METHODS[0],
    base: float = DEFAULT_BASE,
    growth: float = DEFAULT_GROWTH,
    max_sh: int = MAX_SH_DEGREE,
    selection: Selection | None = None,
    refine: bool | int | FitSettings = False,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Tree:
    """Build the Level-of-Detail tree of a scene; the same scene and options give the same tree.

    Args:
        scene: without a tree.
        method: "quick" or "quality".
        base: with quick, growth of the voxel grid from level to level, 1.1 to 2.0.
        growth: with quality, largest number of nodes for each leaf, 1.05 to 2.0.
        max_sh: highest SH degree to keep.
        selection: of splats; by default all that can be drawn.
        refine: fit merged splats to pictures of full detail: True, or a number of steps, or settings. The function
            `refine` does the same and reports the gain.

    Raises:
        FormatError: the scene has a tree already.
        InvalidSplatsError: splats are invalid and `selection` does not drop them, or no splats are selected.
        ValueError: there is no such method, or an option is out of its range.
    """
    if scene_like(scene).tree is not None:
        raise FormatError("the scene has a Level-of-Detail tree already; extract_leaves gives its splats")
    if method not in BUILDERS:
        raise ValueError(f"there is no method {method!r}; give one of {', '.join(BUILDERS)}")
    Range(MIN_BASE, MAX_BASE).check("base", base)
    Range(MIN_GROWTH, MAX_GROWTH).check("growth", growth)
    whole(0, MAX_SH_DEGREE).check("max_sh", max_sh)
    fitting = fit_settings_of(refine)
    settings = BakeSettings(method, base, growth, max_sh, selection or Selection())
    with on_threads(threads), progress_callback(progress) as callback, memory_errors_translated():
        leaves, tally = select(scene.splats, settings, threads=thread_count(threads))
        settings.selection.check(tally)
        tree = Tree(*build_tree([leaves], settings, in_chunks=False, progress=callback), scene.antialiased, up=scene.up)
        return tree if fitting is None else refined_tree(tree, fitting, thread_count(threads), callback, None)[0]


def simplify(
    scene: Scene,
    *,
    to: BudgetLike | None = None,
    psnr: float | None = None,
    refine: bool | int | FitSettings = False,
    cameras: CameraPath | Iterable[Camera] | None = None,
    max_sh: int = MAX_SH_DEGREE,
    selection: Selection | None = None,
    threads: int | None = None,
    progress: ProgressLike = None,
) -> Scene:
    """Return a scene with fewer splats, the same for all cameras: the cut of its quality tree that loses least.

    Opacities are at most 1, so that `write` writes it in every format. The same scene and arguments give the same
    splats.

    Args:
        scene: without a tree; or a tree, which is cut as it is.
        to: a count, a share as a float, or a text such as "100k" or "10%".
        psnr: in place of `to`: keep as few splats as this PSNR against pictures of the scene allows, dB.
        refine: fit the splats to pictures of the scene: True, or a number of steps, or settings.
        cameras: of these pictures; None for cameras around and inside the scene.
        max_sh: highest SH degree to keep.
        selection: of splats; by default all that can be drawn.

    Raises:
        InvalidSplatsError: splats are invalid and `selection` does not drop them, or no splats are selected.
        SparklodError: no camera sees anything.
        TreeError: the tree is broken.
        ValueError: not exactly one of `to` and `psnr` is given, or a number is out of its range.
    """
    goal = SimplifyGoal(None if to is None else budget_like(to), None, psnr)
    path, fitting = None if cameras is None else path_like(cameras), fit_settings_of(refine)
    if fitting is not None and path is not None:
        fitting = dataclasses.replace(fitting, path=path)
    if scene_like(scene).tree is None:
        scene = build_lod(
            scene,
            method="quality",
            growth=DETAIL_GROWTH,
            max_sh=max_sh,
            selection=selection,
            threads=threads,
            progress=progress,
        )
    elif selection is not None or max_sh != MAX_SH_DEGREE:
        raise ValueError("selection and max_sh are for scenes without a tree; give the splats that it was built from")
    else:
        check_valid(scene.splats, thread_count(threads))
    with on_threads(threads) as count, progress_callback(progress) as callback, memory_errors_translated():
        cameras = None if path is None else path.cameras
        chosen, *_ = simplified(
            scene, goal, refine=fitting, cameras=cameras, bytes_of=len, threads=count, progress=callback
        )
        return Scene(chosen.splats, antialiased=scene.antialiased, up=scene.up)


def refine(
    tree: Scene,
    *,
    steps: int | None = None,
    seed: int = 0,
    cameras: CameraPath | Iterable[Camera] | None = None,
    device: str = "cpu",
    threads: int | None = None,
    progress: ProgressLike = None,
    say: Callable[[str], None] | None = None,
) -> tuple[Tree, Refined]:
    """Fit the merged splats of a tree to pictures of full detail, as `build-lod --refine` does.

    The links of the tree, the order of its nodes and its leaves stay as they are, bit for bit. The same tree and
    arguments give the same result for any number of threads.

    Args:
        tree: of any builder, or read from a file.
        steps: number of pictures of cuts to compare; None for one that suits the size of the tree.
        seed: of random cameras and budgets.
        cameras: for which the tree is fitted; None for cameras around and inside the scene.
        device: "cpu", "cuda" for an NVIDIA card, or "auto" for a card if the machine has one. Results of cards differ
            from those of the CPU, but are the same every time.
        say: receives a line of text after each stage.

    Returns:
        the tree, and its gain on held-out cameras.

    Raises:
        FormatError: the scene has no tree.
        TreeError: the tree is broken.
        InvalidSplatsError: a node is no valid splat.
        ValueError: a number is out of its range, there are no cameras, or no such device.
        BackendError: no card can be used.
        OutOfMemoryError: it does not fit into memory.
    """
    if scene_like(tree).tree is None:
        raise FormatError("the scene has no Level-of-Detail tree; build_lod makes one")
    check_valid(tree.splats, thread_count(threads))
    settings = FitSettings(steps, seed, None if cameras is None else path_like(cameras), device)
    with progress_callback(progress) as callback, memory_errors_translated():
        return refined_tree(tree, settings, thread_count(threads), callback, say)


def fit_settings_of(refine: bool | int | FitSettings) -> FitSettings | None:
    """Return the settings of fitting for an argument `refine`; None for no fitting."""
    if isinstance(refine, bool):
        return FitSettings() if refine else None
    if isinstance(refine, FitSettings):
        return refine
    STEPS.check("refine", refine)
    return FitSettings(steps=int(refine))


def refined_tree(
    tree: Scene, settings: FitSettings, threads: int, progress: Progress, say: Callable[[str], None] | None
) -> tuple[Tree, Refined]:
    """Fit the merged splats of a tree; return the tree, and its gain."""
    found, report = refined(tree, settings, threads=threads, progress=progress, say=say or (lambda text: None))
    assert found.tree is not None
    return Tree(found.splats, found.tree, found.antialiased, up=found.up), report


def arrange_chunks(tree: Scene, *, threads: int | None = None, progress: ProgressLike = None) -> Tree:
    """Return a tree with its nodes in the order for streaming; `write` keeps the order that nodes have.

    A chunk of a RAD file is the next 65,536 nodes, so this order determines how many chunks a viewer fetches.
    docs/streaming.md compares it with others; `build-lod --format rad` writes trees in it. The order does not depend on
    the number of threads.

    Raises:
        FormatError: the scene has no tree.
        TreeError: the tree is broken.
    """
    links = scene_like(tree).tree
    if links is None:
        raise FormatError("the scene has no Level-of-Detail tree; build_lod makes one")
    with on_threads(threads), progress_callback(progress) as callback, memory_errors_translated():
        from ..lod.chunk_order import arrange

        splats, links = arrange(tree.splats, links, progress=callback)
    return Tree(splats, links, tree.antialiased, up=tree.up)


def extract_leaves(tree: Scene) -> Scene:
    """Return the splats that a tree was built from, in the order of its leaves.

    Raises:
        FormatError: the scene has no tree.
        TreeError: the tree is broken.
    """
    return leaves_of(scene_like(tree))
