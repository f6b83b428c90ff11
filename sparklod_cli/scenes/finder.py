"""`CutFinder`: what a viewer draws of scenes, for one camera after another."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Protocol

from ..cameras.camera import Camera
from ..lod.continuous import ContinuousCuts
from ..lod.detail_traversal import DetailTraversal
from ..lod.settings import LodSettings
from ..lod.tiles import TileTraversal
from ..lod.traversal import CutView, Traversal
from .loaded import Cut, Part, Scenes


class CutSource(Protocol):
    """Source of the cuts that pictures show: a `CutFinder`, or a `FixedCut`."""

    def cut(self, camera: Camera) -> Cut:
        """Return what a camera sees."""

    def candidates(self) -> Cut:
        """Return all that some camera may see."""


@dataclass(frozen=True)
class FixedCut:
    """One cut for all cameras."""

    whole: Cut

    def cut(self, camera: Camera) -> Cut:
        return self.whole

    def candidates(self) -> Cut:
        return self.whole


class CutFinder:
    """Finds what a viewer draws of scenes; several threads may use it. Without settings it draws full detail.

    `ValueError` if the budget is too small for the roots, or there are too many instances.
    """

    def __init__(self, scenes: Scenes, settings: LodSettings | None) -> None:
        self.scenes, self.settings = scenes, settings
        self._traversal: Traversal | DetailTraversal | TileTraversal | None = None
        self._continuous: ContinuousCuts | None = None
        if settings is not None and scenes.with_cuts:
            self._traversal = scenes.traversal(settings)
            if settings.continuous is not None and isinstance(self._traversal, Traversal):
                self._continuous = ContinuousCuts(self._traversal)

    def with_budget(self, budget: int) -> CutFinder:
        """Return a finder with another budget and its own traversal, as a traversal begins where its last cut ended."""
        twin = copy.copy(self)
        if self.settings is not None and self._traversal is not None:
            twin.settings = replace(self.settings, budget=budget)
            twin._traversal = self.scenes.traversal(twin.settings)
        return twin

    def cut(self, camera: Camera) -> Cut:
        """Return the cut of the trees or detail levels, and all splats of scenes that have none."""
        if self._traversal is None or self.settings is None:
            return self.scenes.full()
        view, limit = view_of(camera), self.settings.limit(camera.fov_y, camera.height)
        if self._continuous is None or self.settings.continuous is None:
            found = self._traversal.cut(view, budget=self.settings.budget, smallest=limit)
            return self.scenes.cut_of(found)
        blended = self._continuous.cut(
            view, budget=self.settings.budget, smallest=limit, width=self.settings.continuous
        )
        masks = [blended.instance == number for number in range(len(self._traversal.instances))]
        nodes = [(blended.node[mask], blended.weight[mask]) for mask in masks]
        return Cut(self.scenes.parts_of(nodes), blended.threshold)

    def candidates(self) -> Cut:
        """Return all that some camera may see: whole trees and all levels where cuts are drawn, else full detail."""
        if self._traversal is None:
            return self.scenes.full()
        return Cut(
            tuple(
                Part(loaded, loaded.every, None, at.object_to_world)
                for at, loaded in zip(self.scenes.instances, self.scenes.of_instance, strict=True)
            )
        )


def view_of(camera: Camera) -> CutView:
    """Return a camera as the traversal sees it."""
    return CutView(camera.camera_to_world, camera.fov_x, camera.fov_y)
