"""Streamed SOG: a manifest, lod-meta.json, and unpacked SOG scenes beside it, each with runs of one detail level.

As a scene it is full detail, level 0, and the environment; `decode_levels` reads all levels.
"""

from __future__ import annotations

from .reading import decode as decode
from .reading import decode_levels as decode_levels
from .reading import stream as stream

# from .writing import encode_files as encode_files
from .writing import encode_files as encode_files
