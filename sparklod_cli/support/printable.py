"""Text from outside, such as names of files and cameras, made safe for terminals and logs of CI runs."""

from __future__ import annotations

#: Most characters of a message. A path can have 4,096, and texts of a file have no limit.
MOST = 500

#: Replaces characters that are left out.
GAP = " ... "

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

#: Code points by which Python represents bytes of a name that are not UTF-8.
_BYTES = range(0xDC80, 0xDD00)


def printable(text: str, most: int | None = None) -> str:
    """A text on one line without any effect on a terminal or a log.

    Characters that are not printable are escaped as in Python's strings: control characters, line ends, marks of
    writing direction, halves of surrogate pairs. So is the beginning of a command of GitHub Actions.

    Args:
        text: any text.
        most: most characters. A longer text is cut in its middle, as it may begin with a file and end with a reason.
    """
    text = shortened(text, most)
    if not text.isprintable():
        text = "".join(mark if mark.isprintable() else _spelt(mark) for mark in text)
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


def _spelt(mark: str) -> str:
    code = ord(mark)
    if code in _BYTES:
        return f"\\x{code - 0xDC00:02x}"
    if code > 0xFFFF:
        return f"\\U{code:08x}"
    return _SHORT.get(mark) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")
