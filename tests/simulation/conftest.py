"""The scenes that tests of frames share."""

from __future__ import annotations

import numpy as np
import pytest

from sparklod_cli.codecs.rad import rad_writer as rad
from sparklod_cli.io.reading import read_scene
from sparklod_cli.model.foveation import Frustum
from sparklod_cli.model.instances import Instance
from sparklod_cli.viewers.loaded_scene import TRAVERSED
from sparklod_cli.viewers.scenes import Scenes, read_scenes
from tests.lod.forests import transform
from tests.simulation.paths import HAND, TOWN


@pytest.fixture(scope="package")
def town() -> Scenes:
    """165,205 nodes in three chunks."""
    return read_scenes([Instance(TOWN, "town")], columns=TRAVERSED, trees_only=True)


@pytest.fixture(scope="package")
def rad_town(tmp_path_factory: pytest.TempPathFactory) -> Scenes:
    """The town as RAD."""
    path = tmp_path_factory.mktemp("rad") / "town.rad"
    path.write_bytes(b"".join(rad.encode(read_scene(TOWN))))
    return read_scenes([Instance(path, "town")], columns=TRAVERSED, trees_only=True)


@pytest.fixture(scope="package")
def three() -> Scenes:
    """The town twice, once turned and larger, and a small tree."""
    return read_scenes(
        [
            Instance(TOWN, "here"),
            Instance(TOWN, "there", transform(np.random.default_rng(1), scale=1.5, spread=3), 0.5, Frustum(0.3, 0.1)),
            Instance(HAND, "hand"),
        ],
        columns=TRAVERSED,
        trees_only=True,
    )
