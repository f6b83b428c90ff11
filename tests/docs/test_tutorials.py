"""docs/tutorials: all commands run, one after the other, and print and draw what the pages show."""

from __future__ import annotations

import re
import shutil
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from subprocess import STDOUT

import numpy as np
import pytest
from PIL import Image

from tests.conftest import FIXTURES
from tests.interop.pictures import psnr

from .gallery import SCENE, SERVERS, TUTORIALS, drawn, folder_of
from .shell import TIMEOUT, Shell

#: Relative tolerance of the numbers in outputs, for other versions of compressors.
TOLERANCE = 0.02

#: Least PSNR in dB of a picture on a page from the one that its command draws: it has been compressed.
LEAST = 30

NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")


def steps(page: Path) -> Iterator[tuple[str, str]]:
    """Yield each script of a page with the output that the page shows of it, which may be abridged or empty."""
    text = page.read_text(encoding="utf-8")
    yield from re.findall(r"^```sh\n(.*?)^```$(?:\n\n```text\n(.*?)^```$)?", text, re.DOTALL | re.MULTILINE)


def is_same(shown: str, line: str) -> bool:
    """Return True if a line of output is the one that a page shows.

    Widths of columns may differ, and numbers by the tolerance. A time at the end of a line may be any, and `...` stands
    for any text.
    """
    shown, line = (" ".join(re.sub(r", [\d.]+ s$", ", TIME", each).split()) for each in (shown, line))
    numbers = NUMBER.findall(shown)
    parts = re.split(rf"({NUMBER.pattern}|\.\.\.)", shown)
    patterns = {"...": ".*", **dict.fromkeys(numbers, f"({NUMBER.pattern})")}
    found = re.fullmatch("".join(patterns.get(part, re.escape(part)) for part in parts), line)
    if found is None:
        return False
    printed, expected = ([float(each.replace(",", "")) for each in some] for some in (found.groups(), numbers))
    return bool(np.allclose(printed, expected, rtol=TOLERANCE, atol=0))


def check_server(shell: Shell, script: str) -> None:
    """Start the server of a script at any free port, fetch its page, and stop it."""
    (command,) = script.splitlines()
    server = shell.start(f"{command} --no-open" if "sparklod" in command else command.replace(" 8000 ", " 0 "))
    try:
        assert server.stdout is not None
        ports = (re.search(r"http://\S+:(\d+)/", line) for line in server.stdout)
        port = next(filter(None, ports))[1]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=TIMEOUT) as page:
            assert b"<title>" in page.read()
    finally:
        server.terminate()
        server.communicate()


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
@pytest.mark.slow
def test_the_commands_print_and_draw_what_the_page_shows(page: Path, tmp_path: Path, shell: Shell) -> None:
    shutil.copy(FIXTURES / SCENE, tmp_path)
    for script, output in steps(page):
        if SERVERS.search(script):
            check_server(shell, script)
            continue
        done = shell(script, errors=STDOUT)
        assert done.returncode == 0, f"{script}\n{done.stdout}"
        printed = iter(done.stdout.splitlines())
        for shown in output.splitlines():
            assert shown == "..." or any(is_same(shown, line) for line in printed), f"{script}\n{shown}\n{done.stdout}"
    for picture in drawn(page):
        ours, stored = (
            np.asarray(Image.open(folder / picture).convert("RGB"), np.float64) / 255
            for folder in (tmp_path, folder_of(page))
        )
        assert psnr(ours - stored) >= LEAST, picture


@pytest.mark.parametrize(
    ("shown", "line", "same"),
    [
        ("a  1,000 nodes, 2.0 s", "a 1,001   nodes, 0.3 s", True),
        ("a  1,000 nodes, 2.0 s", "a 1,100 nodes, 2.0 s", False),
        ("1.5 MB (60 %)", "1.5 GB (60 %)", False),
        ("churn is ...; the worst", "churn is 0.2; the worst", True),
        ("churn is ...; the worst", "growth is 0.2; the worst", False),
    ],
)
def test_lines_are_compared_by_text_and_numbers(shown: str, line: str, same: bool) -> None:
    assert is_same(shown, line) is same
