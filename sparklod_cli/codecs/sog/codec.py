"""SOG, PlayCanvas's splats as WebP images with a texel per splat, and a meta.json that defines their values.

A scene is a zip (.sog) or an unpacked folder. Version 2 maps bytes to values by codebooks, version 1 by ranges; both
are read, and version 2 is written.
"""

from __future__ import annotations

from .options import held as held
from .options import settled as settled
from .reading import decode as decode
from .reading import stream as stream
from .writing import encode as encode
from .writing import encode_files as encode_files
