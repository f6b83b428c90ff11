"""Checks of a scene that is baked, in memory or out of core."""

from __future__ import annotations

from ..model.splats import Splats
from ..model.transforms import Transform
from ..support.errors import InvalidSplatsError


def check_transformed(beyond: int) -> None:
    """Raises `InvalidSplatsError` where a transform moved this many splats out of the range of float32."""
    if beyond:
        raise InvalidSplatsError(
            "scaled and moved like this, it leaves the range of float32; give a smaller --scale or --translate"
        )


def transformed(splats: Splats, transform: Transform) -> Splats:
    """Splats turned, scaled and moved.

    Raises:
        InvalidSplatsError: one leaves the range of float32.
    """
    turned = transform.apply(splats)
    check_transformed(0 if turned is splats else len(turned.invalid()))
    return turned
