"""The parent's side of the process in which Open3D draws; `child` runs in that process."""

from __future__ import annotations

import atexit
import contextlib
import re
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

from ...system.errors import BackendError
from ...system.python_process import module_command
from .child import PACKAGES, Array, receive, send

#: Time limits in seconds for starting the process, and for drawing a piece.
START_LIMIT, DRAW_LIMIT = 180.0, 300.0

#: Maximum number of pairs of splat and tile per request: the capacity of Open3D, and a limit for software rendering by
#: an old Mesa. That of Debian 12, 22.3.6, sorts more than about 100,000 incorrectly, so that tiles are missing; 25.0.7
#: does not.
MOST_ENTRIES, MOST_ENTRIES_OF_OLD_MESA, NEW_MESA = 1 << 25, 1 << 15, 25


def command() -> list[str]:
    """Return the command line of the process in which Open3D draws."""
    return module_command(f"{__package__}.child")


class Child:
    """A process in which Open3D draws, until this one ends; raises `BackendError` if it cannot draw here."""

    def __init__(self) -> None:
        # A file instead of a pipe, which would have to be read while the child writes.
        self._folder = tempfile.TemporaryDirectory(prefix="sparklod-", ignore_cleanup_errors=True)
        self._log = Path(self._folder.name, "log")
        try:
            with self._log.open("wb") as log:
                self._process = subprocess.Popen(command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        except OSError as error:
            self._folder.cleanup()
            raise BackendError(f"the process for Open3D does not start: {error}") from None
        atexit.register(self.close)
        self._answer(START_LIMIT, hint=f" (on Debian and Ubuntu: apt install {PACKAGES})")
        mesa = re.search(r"llvmpipe Mesa (\d+)", self._words())
        #: Maximum number of pairs of splat and tile per request, see `Painter.draw`.
        self.most_entries = MOST_ENTRIES_OF_OLD_MESA if mesa and int(mesa[1]) < NEW_MESA else MOST_ENTRIES

    def alive(self) -> bool:
        """Return whether the process is running."""
        return self._process.poll() is None

    def ask(self, request: dict[str, Any], splats: Array) -> Array:
        """Draw pictures as `Painter.draw`; raise `BackendError` if Open3D has crashed, takes too long or fails."""
        pictures = self._answer(DRAW_LIMIT, request, splats)
        assert pictures is not None
        return pictures

    def _answer(
        self, limit: float, request: dict[str, Any] | None = None, splats: Array | None = None, hint: str = ""
    ) -> Array | None:
        assert self._process.stdin is not None and self._process.stdout is not None
        too_late = threading.Event()

        def stop() -> None:  # ends the wait below on every system
            too_late.set()
            self._process.kill()

        timer = threading.Timer(limit, stop)
        timer.daemon = True
        timer.start()
        try:
            if request is not None:
                send(self._process.stdin, request, splats)
            answer, array = receive(self._process.stdout)
        except (EOFError, OSError):
            if too_late.is_set():
                raise self._error(f"Open3D has not answered for {limit:g} seconds") from None
            raise self._error(f"Open3D has crashed: {self._last_words()}{hint}") from None
        except BaseException:  # the rest of this answer would be read as the next one
            self.close()
            raise
        finally:
            timer.cancel()
        if "error" in answer:
            raise self._error(answer["error"])
        return array

    def _error(self, text: str) -> BackendError:
        self.close()
        return BackendError(text)

    def _words(self) -> str:
        return re.sub(r"\x1b\[[0-9;]*m", "", self._log.read_text("utf-8", "replace"))

    def _last_words(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        lines = [line.strip() for line in self._words().splitlines() if line.strip()]
        return lines[-1] if lines else f"exit code {self._process.returncode}"

    def close(self) -> None:
        """End the process, which exits when its input is closed."""
        atexit.unregister(self.close)
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._folder.cleanup()
