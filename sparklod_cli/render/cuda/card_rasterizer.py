"""Pictures drawn on a card: `CardSplats` are uploaded once, and drawn for many cameras."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...cameras.camera import Camera
from ...model.falloff import MIN_ALPHA
from ...model.sh import COEFFICIENTS
from .. import rasterizer
from ..kernels.project import COLUMNS
from ..rasterizer import Image, ShadedSplats
from ..render_settings import RasterSettings
from . import forward
from .card import CardArray, CardMemory, add_up, card_errors, find_card, on_card, sort, to_card


@dataclass(frozen=True)
class CardSplats:
    """N splats on the card, float32."""

    center: CardArray  # (N, 3)
    scale: CardArray  # (N, 3)
    quat_xyzw: CardArray  # (N, 4)
    lod_opacity: CardArray  # (N,)
    rgb: CardArray  # (N, 3)
    sh: CardArray  # (N, K, 3)
    colors: CardArray  # (N, 3), working memory: colours that the last camera saw
    memory: CardMemory = field(default_factory=CardMemory)  # other working memory, which the next picture overwrites

    @classmethod
    def of(cls, *columns: NDArray[np.float32]) -> CardSplats:
        """Copy columns, in the order of the attributes, to the card."""
        center, scale, quat, lod_opacity, rgb, sh = map(to_card, columns)
        return cls(center, scale, quat, lod_opacity, rgb, sh, on_card(columns[4].shape))

    @property
    def degree(self) -> int:
        return COEFFICIENTS.index(self.sh.shape[1])


@dataclass(frozen=True)
class CardView:
    """A camera and raster settings on the card."""

    camera: Camera
    settings: RasterSettings
    eye: CardArray  # (3,)
    matrix: CardArray  # (3, 4)
    view: CardArray  # numbers of `Lens` and `Limits`. See `forward.project`.

    @classmethod
    def of(cls, camera: Camera, settings: RasterSettings) -> CardView:
        nothing = ShadedSplats(*(np.empty((0, 3), np.float32),) * 5)
        _, matrix, lens, limits = rasterizer.arguments(nothing, camera, settings)
        eye = camera.position.astype(np.float32)
        return cls(camera, settings, to_card(eye), to_card(matrix), to_card(np.array([*lens, *limits], np.float32)))


@dataclass(frozen=True)
class CardPicture:
    """A picture on the card, of M splats, and how it was drawn; the next one of the same splats overwrites it."""

    image: CardArray  # (height, width, 4) float32
    index: CardArray  # (M,) int32, which splats
    screen: CardArray  # these four of `forward.project`, the keys sorted
    keys: CardArray
    boxes: CardArray
    count: CardArray
    ends: CardArray  # (M,) int64, running sums of the tiles of splats in the order of `keys`
    start: CardArray  # (T + 1,) int64, where in `pairs` tiles begin
    pairs: CardArray  # (total,) uint64, of `forward.list_pairs`


def draw_on_card(splats: CardSplats, index: CardArray, view: CardView) -> CardPicture:
    """Draw the splats of an index, (M,) int32, on the card."""
    camera, settings = view.camera, view.settings
    across, down = rasterizer.tiles_across(camera)
    number, new = index.shape[0], splats.memory.array
    screen, boxes = new("screen", (number, COLUMNS)), new("boxes", (number, 4), np.int16)
    keys, count = new("keys", number, np.uint64), new("count", number, np.int32)
    ends = new("ends", number, np.int64)
    columns = splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.rgb, splats.sh
    camera_on_card = view.eye, view.matrix, view.view, settings.sort == "radial"
    results = splats.colors, screen, keys, boxes, count
    forward.project.for_each(number, *columns, splats.degree, index, *camera_on_card, *results)
    sort(keys)
    forward.count_in_order.for_each(number, keys, count, ends)
    pairs = new("pairs", add_up(ends), np.uint64)
    start = new("start", across * down + 1, np.int64)
    if not pairs.shape[0]:
        start.copy_to_device(np.zeros(start.shape, np.int64))
    forward.list_pairs.for_each(number, keys, boxes, ends, across, pairs)
    sort(pairs)
    forward.find_starts.for_each(pairs.shape[0], pairs, start)
    image = new("image", (camera.height, camera.width, 4))
    is_design = settings.profile == "shifted"
    drawn = screen, keys, start, pairs, across, is_design, np.float32(MIN_ALPHA), image
    forward.blend.launch(across * down, forward.PIXELS, *drawn)
    return CardPicture(image, index, screen, keys, boxes, count, ends, start, pairs)


def draw(splats: ShadedSplats, camera: Camera, settings: RasterSettings) -> Image:
    """Draw what a camera sees, as `rasterizer.draw` does; BackendError without a usable card or enough memory on it."""
    find_card()
    with card_errors(len(splats)):
        no_sh = np.empty((len(splats), 0, 3), np.float32)
        uploaded = CardSplats.of(splats.center, splats.scale, splats.quat_xyzw, splats.lod_opacity, splats.rgb, no_sh)
        every = to_card(np.arange(len(splats), dtype=np.int32))
        image: Image = draw_on_card(uploaded, every, CardView.of(camera, settings)).image.copy_to_host()
    return image
