"""Makes untrusted text, such as names of files and cameras, safe for terminals and CI logs."""

from __future__ import annotations

#: Maximum length of a message, in characters. A path can have 4,096, and strings in a file have no limit.
MOST = 500

#: Replaces the omitted middle of a text.
GAP = " ... "

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

#: Code points with which Python represents bytes of a file name that are not UTF-8.
_BYTES = range(0xDC80, 0xDD00)


def printable(text: str, most: int | None = None) -> str:
    """A text on one line that cannot control a terminal or a log.

    Unprintable characters are escaped as in Python strings: control characters, line ends, directional marks and lone
    surrogates. So is the start of a GitHub Actions command.

    Args:
        text: any text.
        most: maximum length. A longer text loses its middle, since it may begin with a path and end with a reason.
    """
    text = shortened(text, most)
    if not text.isprintable():
        text = "".join(mark if mark.isprintable() else _escaped(mark) for mark in text)
    text = text.replace("##[", "\\x23#[")
    if text.lstrip().startswith("::"):
        text = text.replace(":", "\\x3a", 1)
    return shortened(text, most)


def shortened(text: str, most: int | None) -> str:
    """A text of at most `most` characters: the beginning and the end of a longer one."""
    if most is None or len(text) <= most:
        return text
    end = (most - len(GAP)) // 4
    return text[: most - len(GAP) - end] + GAP + text[len(text) - end :]


def _escaped(mark: str) -> str:
    code = ord(mark)
    if code in _BYTES:
        return f"\\x{code - 0xDC00:02x}"
    if code > 0xFFFF:
        return f"\\U{code:08x}"
    return _SHORT.get(mark) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")
