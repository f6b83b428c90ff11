"""Text from outside, such as the name of a file or of a camera, as a terminal or the log of a CI run may show it."""

from __future__ import annotations

#: Characters of a message at most. A path can have 4,096, and what a file says of itself any number.
MOST = 500

#: What stands for characters that are left out.
GAP = " ... "

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

#: Bytes of a name that are no UTF-8, as Python holds them.
_BYTES = range(0xDC80, 0xDD00)


def printable(text: str, most: int | None = None) -> str:
    """A text on one line that does nothing but stand there.

    What is not printable is spelt as in Python's strings: control characters and line ends, marks that turn the
    direction of writing, half surrogate pairs. So is the first mark of what GitHub Actions would take for a command.

    Args:
        text: any.
        most: characters of a text that is shortened in its middle, as it may begin with a file and end with a reason.
    """
    text = shortened(text, most)
    if not text.isprintable():
        text = "".join(mark if mark.isprintable() else _spelt(mark) for mark in text)
    text = text.replace("##[", "\\x23#[")
    if text.lstrip().startswith("::"):
        text = text.replace(":", "\\x3a", 1)
    return shortened(text, most)


def shortened(text: str, most: int | None) -> str:
    """A text of at most so many characters: beginning and end of a longer one."""
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
