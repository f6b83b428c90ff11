"""Destination of the table of a command: a file, standard output, or none but a summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..system.output import check_writable, write_file
from ..system.stdio import DASH
from .columns import Column, Row, encode, load_pyarrow

#: What the bytes of a table are passed through on their way to standard output.
Filter = Callable[[Iterable[bytes]], Iterable[bytes]]


@dataclass(frozen=True)
class TableOutput:
    """Destination of a table.

    Attributes:
        path: of its file; None for standard output, or for nowhere.
        form: a key of `files.FORMS`; None for nowhere: rows are made, and not written.
    """

    path: Path | None
    form: str | None
    columns: Sequence[Column]
    overwrite: bool = False

    @property
    def on_stdout(self) -> bool:
        """Whether the table goes to standard output."""
        return self.path is None and self.form is not None

    def check(self) -> None:
        """Raise a `SparklodError` where the table cannot be written, before work goes into it."""
        if self.path is not None:
            check_writable(self.path, overwrite=self.overwrite)
        if self.form == "parquet":
            load_pyarrow()

    def write(self, rows: Iterable[Row], *, passed: Filter | None = None) -> None:
        """Make all rows and write them, as they come.

        Args:
            passed: what the bytes are passed through on their way to standard output.

        Raises:
            OutputError: the file cannot be written.
        """
        if self.form is None:
            for _ in rows:
                pass
            return
        data: Iterable[bytes] = encode(iter(rows), self.columns, self.form)
        if self.path is None and passed is not None:
            data = passed(data)
        write_file(self.path or DASH, data, overwrite=self.overwrite, may_end=self.form != "parquet")
