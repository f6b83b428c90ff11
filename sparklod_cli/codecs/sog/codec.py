"""SOG, PlayCanvas's splats as WebP images with a texel per splat, and a meta.json that defines their values.

A scene is a zip (.sog) or an unpacked folder. Version 2 maps bytes to values by codebooks, version 1 by ranges.
"""

from __future__ import annotations

from .reading import decode as decode
from .reading import stream as stream
