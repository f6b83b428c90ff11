"""Makes text, such as names of files, cameras and addresses, safe for terminals and CI logs."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

#: Maximum length of a message, in characters. A path can have 4,096, and strings in a file have no limit.
MOST = 500

#: Replaces the omitted middle of a text.
GAP = " ... "

#: Replaces passwords and signatures in addresses.
HIDDEN = "***"

#: User and password of an address, up to its host: the password may hold an @ or, if it begins like no port, a slash.
_CREDENTIALS = re.compile(r"(?<=://)[^\s/:@]{0,256}:(?:[^\s/]{0,1024}|(?!:|\d{1,5}/)[^\s@]{0,1024})@")

#: The query of an address of the web, or one of parameters; elsewhere a ? may be in a name.
_QUERY = re.compile(
    r"((?i:https?)://[^\s?]{0,4096}|://[^\s?]{0,4096}(?=\?\S{0,4096}?=))\?[^\s'\"]{0,8192}[^\s'\",:;.)]"
)

_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}

#: Code points with which Python represents bytes of a file name that are not UTF-8.
_BYTES = range(0xDC80, 0xDD00)


def printable(text: str, most: int | None = None) -> str:
    """Return a text on one line that cannot control a terminal or a log.

    Unprintable characters are escaped as in Python strings: control characters, line ends, directional marks and lone
    surrogates. So is the start of a GitHub Actions command. What addresses must not show is hidden, see `redacted`.

    Args:
        most: maximum length. A longer text loses its middle, since it may begin with a path and end with a reason.
    """
    text = shortened(redacted(text), most)
    if not text.isprintable():
        text = "".join(mark if mark.isprintable() else _escaped(mark) for mark in text)
    text = text.replace("##[", "\\x23#[")
    if text.lstrip().startswith("::"):
        text = text.replace(":", "\\x3a", 1)
    return shortened(text, most)


def redacted(text: str) -> str:
    """Return a text in which the addresses have no passwords, and no queries, which may be signatures."""
    return _QUERY.sub(rf"\1?{HIDDEN}", _CREDENTIALS.sub(f"{HIDDEN}@", text)) if "://" in text else text


def without_secrets(text: str, url: str) -> str:
    """Return a text about an address without its passwords and queries, which it may quote by themselves."""
    credentials = [match[0][:-1] for match in _CREDENTIALS.finditer(url)]
    queries = [match[0][len(match[1]) + 1 :] for match in _QUERY.finditer(url)]
    secrets = (*credentials, *(each.partition(":")[2] for each in credentials), *queries)
    for secret in sorted(filter(None, secrets), key=len, reverse=True):
        text = re.sub(re.escape(secret), HIDDEN, text, flags=re.IGNORECASE)
    return redacted(text)


def shortened(text: str, most: int | None) -> str:
    """Return a text of at most `most` characters: the beginning and the end of a longer one."""
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


def near(name: str, known: Iterable[str], *, cutoff: float = 0.6, folder: Path | None = None) -> str:
    """Return the end of an error about an unknown name, ", did you mean ...?"; empty if no known name is similar.

    Args:
        cutoff: how similar they must be, 0 to 1, as `difflib` measures it.
        folder: of the names, where they are files.
    """
    import difflib  # which takes a millisecond, and is needed after a mistake only

    found = difflib.get_close_matches(name, list(known), n=3, cutoff=cutoff)
    return f", did you mean {' or '.join(str(folder / each) if folder else each for each in found)}?" if found else ""
