"""Scenes made from a tree, which are its leaves or a simplified cut, and fitting of trees and cuts: `--refine`."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..codecs.formats import Format, WriteOptions
from ..codecs.losses import Losses, settled_with_losses
from ..fitting.fit_settings import FitSettings, Refined
from ..io.writing import encoded, write_scene
from ..model.falloff import MIN_ALPHA
from ..model.scene import Scene
from ..model.splats import Splats
from ..system import interrupts
from ..system.errors import FormatError, SparklodError
from ..system.output import Output
from ..system.progress import Progress
from ..system.threads import on_threads
from ..system.units import count_of

if TYPE_CHECKING:
    from ..cameras.camera import Camera
    from ..lod.budget import Budget

#: Number and seed of the cameras by which a PSNR is measured if the user names none.
CAMERAS, SEED = 16, 0

#: Tolerances as shares: of a file below --max-bytes, and of splats above the fewest that have a PSNR. Each further
#: halving costs one more encoding, or pictures of all cameras. Chosen.
CLOSE_BYTES, CLOSE_COUNT = 0.002, 0.01

#: Most encodings. Files grow nearly in proportion to their splats, so 3 to 6 suffice. Chosen.
MOST_TRIALS = 16


@dataclass(frozen=True)
class SimplifyGoal:
    """Goal of a simplified scene, exactly one of three; raises `ValueError` if it is out of its range.

    Attributes:
        to: number of splats, or a share of all.
        max_bytes: largest size of the file, which as many splats as possible fill.
        psnr: least PSNR against full detail, dB, which as few splats as possible reach.
    """

    to: Budget | None = None
    max_bytes: int | None = None
    psnr: float | None = None

    def __post_init__(self) -> None:
        if sum(each is not None for each in (self.to, self.max_bytes, self.psnr)) != 1:
            raise ValueError("give one of to, max_bytes and psnr")
        if self.max_bytes is not None and self.max_bytes < 1:
            raise ValueError(f"max_bytes is {self.max_bytes}; give 1 or more")
        from ..images.metrics import MOST_PSNR

        if self.psnr is not None and not 0 < self.psnr < MOST_PSNR:
            raise ValueError(f"psnr is {self.psnr}; give more than 0 and less than {MOST_PSNR:g} dB")


#: Measures the file or the pictures of a cut of this many splats.
Measure = Callable[[int], float]


def largest_for_bytes(most: int, leaves: int, bytes_of: Measure, progress: Progress) -> int:
    """Return the largest number of splats, up to `leaves`, whose file has at most `most` bytes, within `CLOSE_BYTES`.

    Raise `FormatError` if not even one splat fits.
    """
    low, high, below, above = 1, leaves, bytes_of(1), bytes_of(leaves)
    if above <= most:
        return leaves
    if below > most:
        raise FormatError(f"one splat takes {below:,.0f} bytes in this format, more than {most:,}; allow more bytes")
    for trial in range(MOST_TRIALS):
        progress("simplifying", trial, MOST_TRIALS, "file")
        if high - low <= 1 or most - below <= CLOSE_BYTES * most:
            break
        # Sizes are nearly linear, so interpolate; halving advances where that stays at one end.
        guess = low + (high - low) * (most - below) / (above - below) if trial % 4 < 3 else (low + high) / 2
        count = min(max(math.floor(guess), low + 1), high - 1)
        size = bytes_of(count)
        if size <= most:
            low, below = count, size
        else:
            high, above = count, size
    return low


def fewest_for_psnr(least: float, leaves: int, psnr_of: Measure, progress: Progress) -> tuple[int, float]:
    """Return the least number of splats whose PSNR is at least `least` dB, within `CLOSE_COUNT`, and their PSNR."""
    low, high, best = 0, leaves, psnr_of(leaves)
    trials = math.ceil(math.log2(max(math.log(max(leaves, 2)) / math.log1p(CLOSE_COUNT), 1)))
    for trial in range(trials):
        progress("simplifying", trial, trials, "picture set")
        count = round(math.sqrt(max(low, 1) * high))
        if not low < count < high:
            break
        found = psnr_of(count)
        if found >= least:
            high, best = count, found
        else:
            low = count
    return high, best


class Fidelity:
    """PSNR of cuts of a tree against its leaves, measured on pictures.

    Args:
        tree: with opacities of at most 1.
        cameras: None for `CAMERAS` around and inside the scene.

    Raises:
        SparklodError: no camera sees anything.
    """

    def __init__(self, tree: Scene, cameras: Sequence[Camera] | None, threads: int) -> None:
        from ..fitting.fit import raster_for
        from ..fitting.pictures import FittedNodes, Place, pictures, placed

        assert tree.tree is not None
        place = Place.of(tree.splats.center[tree.tree.is_leaf])
        self._nodes = FittedNodes(tree.splats, tree.tree, raster_for(place), threads)
        many = placed(place, np.random.SeedSequence(SEED)) if cameras is None else iter(cameras)
        self._pictures = list(itertools.islice(pictures(many, self._nodes), CAMERAS if cameras is None else None))
        if not self._pictures:
            raise SparklodError("no camera sees enough to measure a PSNR by; name cameras with --camera-path")

    def psnr(self, cut: NDArray[np.int64]) -> float:
        """Return the mean PSNR of a cut, node numbers ascending, over all cameras and black and white, dB."""
        from ..fitting.pictures import mean_psnr

        return mean_psnr(self._nodes, lambda camera: cut, self._pictures)

    def fitted(self, cut: NDArray[np.int64], nodes: Splats) -> float:
        """Replace the nodes of the tree, also for later cuts, and return the mean PSNR of a cut, dB."""
        from ..fitting.pictures import columns_of

        self._nodes.restore(cut, columns_of(nodes))
        return self.psnr(cut)


def simplified(
    tree: Scene,
    goal: SimplifyGoal,
    *,
    refine: FitSettings | None,
    cameras: Sequence[Camera] | None,
    bytes_of: Callable[[Scene], float],
    threads: int,
    progress: Progress,
    say: Callable[[str], None] = lambda text: None,
) -> tuple[Scene, int, float | None, Refined | None]:
    """Find the cut of a tree that meets a goal, and fit it if requested.

    Args:
        refine: settings of fitting the cut to pictures of full detail; None for no fitting.
        cameras: for a PSNR; None for cameras around and inside the scene.
        bytes_of: returns the size of the file of a scene.

    Returns:
        the cut as a scene without a tree; `WrittenSet.faint`; and its PSNR and the result of fitting, if requested.

    Raises:
        FormatError, SparklodError: see `largest_for_bytes` and `Fidelity`; or viewers would draw nothing of the cut.
        KeyboardInterrupt: see `refined`.
    """
    from ..lod.parts import RefinementOrder, with_plain_opacity

    assert tree.tree is not None
    progress("simplifying", 0, 1, "cut")
    order, is_leaf = RefinementOrder(tree.splats, tree.tree), tree.tree.is_leaf
    tree = dataclasses.replace(tree, splats=with_plain_opacity(tree.splats))

    def cut(count: int) -> Scene:
        return dataclasses.replace(tree, splats=tree.splats.take(order.cut(count)), tree=None)

    fidelity, measured = None, None
    if goal.to is not None:
        count = min(order.leaves, goal.to.of(order.leaves))
    elif goal.max_bytes is not None:
        count = largest_for_bytes(goal.max_bytes, order.leaves, lambda count: bytes_of(cut(count)), progress)
    else:
        assert goal.psnr is not None
        measurer = fidelity = Fidelity(tree, cameras, threads)
        count, measured = fewest_for_psnr(
            goal.psnr, order.leaves, lambda count: measurer.psnr(order.cut(count)), progress
        )
    fixed, is_seen = order.cut(count), tree.splats.opacity >= MIN_ALPHA
    faint = int(np.count_nonzero(~is_seen[fixed] & ~is_leaf[fixed]))
    if faint and not is_seen[fixed].any() and is_seen[is_leaf].any():
        raise SparklodError(
            f"nothing could be seen of {count_of(len(fixed), 'splat')}: merged across wide gaps, their opacity is"
            f" {tree.splats.opacity[fixed].max():.1g} at most, and viewers draw none"
            f" below {MIN_ALPHA:.1g}; keep more splats"
        )
    if refine is None:
        return cut(count), faint, measured, None
    fitted, report = refined(tree, refine, fixed=fixed, threads=threads, progress=progress, say=say)
    measured = None if fidelity is None else fidelity.fitted(fixed, fitted.splats)
    scene = dataclasses.replace(fitted, splats=fitted.splats.take(fixed), tree=None)
    return scene, faint, measured, report


def write_simplified(
    tree: Scene,
    goal: SimplifyGoal,
    out: Output,
    form: Format,
    options: WriteOptions,
    end: Callable[[str], None],
    threads: int,
    progress: Progress,
    *,
    leaves: int,
    **how: Any,
) -> tuple[int, WrittenSet]:
    """Cut a tree and write the cut as a scene without a tree; return the bytes of its files, and a record.

    Args:
        end: called with the name of each stage but the last, when it is done.
        leaves: number of splats at full detail.
        how: further arguments of `simplified`.
    """

    def bytes_of(scene: Scene) -> int:
        files = encoded(out, form, scene, form.codec().settled(scene, options), threads=threads)
        return sum(sum(map(len, pieces)) for _, pieces in files)

    with on_threads(threads):
        scene, faint, psnr, refine = simplified(
            tree, goal, bytes_of=bytes_of, threads=threads, progress=progress, **how
        )
    settled, losses = settled_with_losses(scene, form, options, threads)
    end("simplify")
    size = write_scene(out, form, scene, settled, threads=threads, progress=progress)
    share = round(len(scene) / leaves, 6)
    return size, WrittenSet(**vars(losses), splats=len(scene), share=share, faint=faint, psnr=psnr, refine=refine)


@dataclass(frozen=True)
class WrittenSet(Losses):
    """Record of a simplified scene.

    Attributes:
        share: of the splats of full detail.
        faint: number of merged splats too faint for any viewer to draw: merged from splats far apart, they also cover
            the gaps between, and so have hardly any opacity.
        psnr: mean over the cameras and a black and a white background, dB; None if not measured.
        refine: result of fitting; None without `--refine`.
    """

    splats: int
    share: float
    faint: int
    psnr: float | None
    refine: Refined | None


def refined(
    scene: Scene,
    settings: FitSettings,
    *,
    fixed: NDArray[np.int64] | None = None,
    threads: int,
    progress: Progress,
    say: Callable[[str], None],
) -> tuple[Scene, Refined]:
    """Fit the merged splats of a tree; return the tree and the result.

    A first Ctrl-C ends the fitting early, with the improvements of finished stages.

    Args:
        fixed: see `fitting.fit.fit`.

    Raises:
        KeyboardInterrupt: Ctrl-C came before the fitting improved anything.
    """
    from ..fitting.fit import fit

    assert scene.tree is not None
    start = time.perf_counter()
    with interrupts.deferred() as interrupted:
        nodes, report = fit(
            scene.splats,
            scene.tree,
            settings,
            fixed=fixed,
            antialiased=scene.antialiased,
            threads=threads,
            progress=progress,
            say=say,
            interrupted=interrupted,
        )
    if not report.is_complete:
        if not report.kept:
            say("Stopped before --refine improved anything; no file written.")
            raise KeyboardInterrupt
        say("Interrupted: writing the improvements of the finished stages; another Ctrl-C ends without an output.")
    # Centres stay in their former box: in a larger one, a format may have fewer bits for coordinates, and leaves move.
    before = scene.splats.center
    nodes = dataclasses.replace(nodes, center=nodes.center.clip(before.min(axis=0), before.max(axis=0)))
    report = dataclasses.replace(report, seconds=round(time.perf_counter() - start, 4))
    return dataclasses.replace(scene, splats=nodes), report


def leaves_of(scene: Scene) -> Scene:
    """Return the splats that a tree was built from, as a scene without a tree; raise `FormatError` without a tree."""
    if scene.tree is None:
        raise FormatError("it has no Level-of-Detail tree whose leaves could be written")
    leaves = scene.splats.take(scene.tree.is_leaf)
    # A leaf is an input splat. One whose opacity is above 1 comes from a writer that rounds up.
    leaves = dataclasses.replace(leaves, opacity=np.minimum(leaves.opacity, np.float32(1)))
    return Scene(leaves, antialiased=scene.antialiased, format=scene.format, header=scene.header, up=scene.up)
