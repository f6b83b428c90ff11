"""Results of traversals, comparisons and renderings: tables, and a picture that notebooks show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..tables.columns import Table
from .arguments import file_path

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..simulation.summary import Summary
    from ..tables.comparison import BudgetSummary


class Frames(Table):
    """The rows of a traversal: one for each frame and, if asked for, one for each of its instances."""

    def summary(self) -> Summary:
        """Return statistics of the frames, totals, and the frames that are worth a look."""
        from ..simulation.summary import summarize

        return summarize(self.rows)


@dataclass(frozen=True, eq=False, repr=False)
class ComparisonTable(Table):
    """The rows of a comparison: for each camera one for each budget.

    Attributes:
        budgets: as they were given.
    """

    budgets: Sequence[str]

    def summary(self) -> list[BudgetSummary]:
        """Return means and extremes over the frames, for each budget."""
        from ..tables.comparison import summarize

        return summarize(self.rows, self.budgets)


class Picture:
    """A picture that Jupyter shows.

    Attributes:
        png: the bytes of the file.
    """

    def __init__(self, png: bytes) -> None:
        self.png = png

    def __repr__(self) -> str:
        return f"Picture({len(self.png):,} bytes of PNG)"

    def _repr_png_(self) -> bytes:
        return self.png

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the PNG, whole or not at all.

        Raises:
            OutputError: the file exists, or cannot be written.
            ValueError: its name does not end in .png.
        """
        from ..io import write_whole

        path = file_path(path)
        if path.suffix.lower() != ".png":
            raise ValueError(f"{path}: a picture is saved as .png, which the name does not end in")

        write_whole(path, [self.png], overwrite=overwrite)


def show(image: NDArray[np.float32], *, background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> Picture:
    """Return a picture of floats as one that Jupyter shows.

    Args:
        image: (H, W, 4) float32 with alpha multiplied in, as `render` draws it.
        background: red, green and blue, 0..1, behind it; None keeps alpha.

    Raises:
        ValueError: the image has another shape.
    """
    from ..images import pixels

    if getattr(image, "ndim", 0) != 3 or image.shape[2] != 4:
        raise ValueError(f"the image has the shape {getattr(image, 'shape', ())}; give (H, W, 4), as render draws it")

    return Picture(pixels.encode(pixels.eight_bits(pixels.over(image, background)), "png"))
