"""Engines: PlayCanvas, SuperSplat's viewer and Babylon.js show SOG, CesiumJS 3D Tiles; and splat-transform."""

from __future__ import annotations

#: The versions that these tests were written for. Babylon.js unpacks .sog files with fflate.
PACKAGES = {
    "playcanvas": "2.23.3",
    "@playcanvas/supersplat-viewer": "1.36.2",
    "@playcanvas/splat-transform": "3.7.0",
    "@babylonjs/core": "9.34.0",
    "@babylonjs/loaders": "9.28.0",
    "fflate": "0.8.3",
    "cesium": "1.145.0",
    "playwright-core": "1.65.1",
}
