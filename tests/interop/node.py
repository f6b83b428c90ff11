"""A program in Node that answers requests, one line of JSON each."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Timer
from typing import Any

#: Time limit of a request, in seconds: far above what any takes, so that only a request that hangs fails.
SECONDS = 120


class Node:
    """One Node process, which answers one request after the other.

    Args:
        command: the program and its arguments.
        log: the file for its standard error.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self._log = log
        with log.open("wb") as stderr:
            self._process = subprocess.Popen(
                ["node", *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, encoding="utf-8"
            )

    def close(self) -> None:
        assert self._process.stdin and self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(SECONDS)

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the answer to a request; raises an `AssertionError` if it is an error or the process ends."""
        assert self._process.stdin and self._process.stdout
        watchdog = Timer(SECONDS, self._process.kill)
        watchdog.start()
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            answer: dict[str, Any] = json.loads(self._process.stdout.readline() or '{"error": "the process ended"}')
        except BrokenPipeError:
            answer = {"error": "the process ended"}
        finally:
            watchdog.cancel()
        if "error" in answer:
            said = self._log.read_text(encoding="utf-8", errors="replace")[-2000:]
            raise AssertionError(f"{request} failed: {answer['error']}\n{said}")
        return answer
