"""Gradients that a card computes are those of the processor. `tests.fitting.cuda` has them computed twice."""

from __future__ import annotations

import numpy as np

from sparklod_cli.model.gaussian import lod_opacity
from sparklod_cli.render import gradients as on_processor
from sparklod_cli.render.kernels.backward import CENTER, LOD_OPACITY, LOG_SCALE, RGB, TURN
from sparklod_cli.render.rasterizer import shade
from sparklod_cli.render.settings import RasterSettings
from tests.cards import MARKS
from tests.render.cuda.test_pictures import camera_at, splats_of

pytestmark = MARKS

COLUMNS = {
    "center": slice(CENTER, CENTER + 3),
    "log_scale": slice(LOG_SCALE, LOG_SCALE + 3),
    "turn": slice(TURN, TURN + 3),
    "lod_opacity": LOD_OPACITY,
    "rgb": slice(RGB, RGB + 3),
}

#: Largest difference to the processor's, over the largest derivative of the property. Chosen: sums are of float32.
MOST = 1e-3


def test_gradients_are_those_of_the_processor() -> None:
    from sparklod_cli.render.cuda.backward import BATCH, gradients_on_card
    from sparklod_cli.render.cuda.card import to_card
    from sparklod_cli.render.cuda.rasterizer import CardSplats, CardView, draw_on_card

    splats, camera, settings = splats_of(40), camera_at(size=(18, 10)), RasterSettings(max_radius=25.0)
    by_image = np.random.default_rng(1).normal(size=(camera.height, camera.width, 4)).astype(np.float32)
    drawing = on_processor.draw(shade([(splats, np.eye(4))], camera), camera, settings)
    reference = drawing.gradients(by_image)
    d = lod_opacity(splats.opacity)
    uploaded = CardSplats.of(splats.center, splats.scale, splats.quat_xyzw, d, splats.rgb, splats.sh)
    view = CardView.of(camera, settings)
    drawn = draw_on_card(uploaded, to_card(np.arange(len(splats), dtype=np.int32)), view)
    assert np.diff(drawn.start.copy_to_host()).max() > BATCH
    found = gradients_on_card(uploaded, drawn, view, to_card(by_image)).copy_to_host()
    for name, columns in COLUMNS.items():
        expected = getattr(reference, name)
        assert np.abs(expected).max() > 0
        assert np.abs(found[:, columns] - expected).max() < MOST * np.abs(expected).max(), name
