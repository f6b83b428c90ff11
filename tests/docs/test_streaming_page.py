"""The picture of docs/streaming-measured.md shows the figures of its table."""

from __future__ import annotations

from tests.docs.chunk_order_picture import PICTURE, picture


def test_the_picture_is_of_the_table() -> None:
    """If not: `python -m tests.docs.chunk_order_picture`."""
    assert PICTURE.read_text(encoding="utf-8") == picture()
