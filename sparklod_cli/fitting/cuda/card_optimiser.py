"""`CardOptimiser`: steps on a card, with the nodes, their moments and the pictures of full detail in its memory."""

from __future__ import annotations

import functools

import numpy as np

from ...render.cuda.card import CardArray, card_errors, on_card, to_card
from ...render.cuda.card_gradients import gradients_on_card
from ...render.cuda.card_rasterizer import CardPicture, CardSplats, CardView, draw_on_card
from ..kernels import adam
from ..pictures import LEAST_ERROR, FittedNodes, FullDetailPicture, Index, Optimiser, initial_state
from . import kernels


class CardOptimiser(Optimiser):
    """Adam on a card for the merged splats of a tree; BackendError if the memory of the card does not suffice.

    The columns of the nodes in memory are those of the last `synchronize`.
    """

    def __init__(self, nodes: FittedNodes) -> None:
        self.nodes, self._moved = nodes, []
        self._errors = functools.partial(card_errors, len(nodes.leaves))
        slots, moments = initial_state(nodes)
        with self._errors():
            self._now = CardSplats.of(*nodes.columns)
            self._old = tuple(map(to_card, nodes.old))
            self._slots = to_card(slots)
            self._moments = adam.Moments(*map(to_card, moments))
            self._rates = on_card(len(adam.Rates._fields))
        # Cameras and pictures on the card, by the identity of pictures, which live as long as the fit.
        self._examples: dict[int, tuple[CardView, CardArray]] = {}

    def step(self, picture: FullDetailPicture, index: Index, rates: adam.Rates) -> None:
        with self._errors():
            if id(picture) not in self._examples:
                view = CardView.of(picture.camera, self.nodes.raster)
                self._examples[id(picture)] = view, to_card(picture.full)
            view, full = self._examples[id(picture)]
            drawn = self._now.memory.array("index", len(index), np.int32)
            if len(index):
                drawn.copy_to_device(index.astype(np.int32))
            seen = draw_on_card(self._now, drawn, view)
            gradients = gradients_on_card(self._now, seen, view, self._by_image(seen, full))
            moved = self._move(drawn, view, gradients, rates)
        self._moved.append((index, moved))

    def place(self) -> None:
        for index, moved in self._moved:
            self.nodes.place(index, moved[:, :3], moved[:, 3])
        self._moved.clear()

    def _by_image(self, seen: CardPicture, full: CardArray) -> CardArray:
        """Return the derivative of the mean logarithm of the errors; see `FullDetailPicture.gradient`."""
        new, (height, width, _) = self._now.memory.array, seen.image.shape
        sums, weights = new("errors", (height, 2), np.float64), new("weights", 2)
        result = new("by image", seen.image.shape)
        kernels.squared_differences.launch(height, kernels.ROW_THREADS, seen.image, full, sums)
        kernels.weigh_backgrounds.launch(1, 32, sums, float(height * width * 3), LEAST_ERROR, weights)
        kernels.by_image.for_each(height * width, seen.image, full, weights, result)
        return result

    def _move(self, index: CardArray, view: CardView, gradients: CardArray, rates: adam.Rates) -> np.ndarray:
        """Move the drawn nodes; return (M, 4) their centres and feature sizes."""
        now, new, number = self._now, self._now.memory.array, index.shape[0]
        by_color, moved = new("by color", (number, 3)), new("moved", (number, 4))
        by_coefficients = new("by coefficients", (number, *now.sh.shape[1:]))
        derivatives = gradients, by_color, by_coefficients
        kernels.by_sh.for_each(number, now.center, index, view.eye, now.colors, *derivatives)
        self._rates.copy_to_device(np.array(rates, np.float32))
        columns = now.center, now.scale, now.quat_xyzw, now.lod_opacity, now.rgb, now.sh
        state = self._rates, *self.nodes.bounds, *self._moments, moved
        kernels.step.for_each(number, *columns, *self._old, index, self._slots, *derivatives, *state)
        return moved.copy_to_host()

    def synchronize(self) -> None:
        """Copy the columns of the nodes from the card."""
        with self._errors():
            for name, column in self.nodes.columns._asdict().items():
                if column.size:
                    column[...] = getattr(self._now, name).copy_to_host()
