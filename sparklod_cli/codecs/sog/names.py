"""Names of the files of an unpacked SOG: those that PlayCanvas's tools give them."""

from __future__ import annotations

META = "meta.json"

#: The images by texture, in the order in which meta.json names them.
IMAGES = {
    "means": ("means_l.webp", "means_u.webp"),
    "scales": ("scales.webp",),
    "quats": ("quats.webp",),
    "sh0": ("sh0.webp",),
    "shN": ("shN_centroids.webp", "shN_labels.webp"),
}

_ALL = [name for names in IMAGES.values() for name in names]


def number_of(name: str) -> int | None:
    """The image whose file is called this, counted over all textures; None if it is none of these names."""
    return _ALL.index(name) if name in _ALL else None
