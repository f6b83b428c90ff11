"""How fast the machine is just now: `python benchmarks/performance/calibration.py` prints it as JSON.

Measured right before and after each table, it tells a slow machine or a slow minute from slow code. It runs in a
process of its own, so that what the benchmark keeps in memory changes nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

#: Bytes of a copy: larger than a processor's caches, or than this process's share of them.
COPIED = 128 << 20

#: Numbers of the arithmetic kernel, 16 kB that stay in the first cache; how often it takes them, and degree of its
#: polynomial, of which every step is a multiplication and an addition.
NUMBERS, TIMES, DEGREE = 4096, 8000, 16

#: Names of what is measured.
NAMES = ("cold_gb_s", "warm_gb_s", "one_gflop_s", "two_gflop_s")


@dataclass(frozen=True)
class Calibration:
    """Runs of each figure.

    Attributes:
        cold_gb_s: GB a second copied into memory that the process touches for the first time.
        warm_gb_s: the same into memory that it has touched.
        one_gflop_s, two_gflop_s: thousand million additions and multiplications a second of float32, on one thread and
            on two at once.
    """

    cold_gb_s: Sequence[float]
    warm_gb_s: Sequence[float]
    one_gflop_s: Sequence[float]
    two_gflop_s: Sequence[float]

    def medians(self) -> dict[str, float]:
        return {name: median(getattr(self, name)) for name in NAMES}

    def as_json(self) -> dict[str, list[float]]:
        return {name: [float(f"{run:.4g}") for run in runs] for name, runs in asdict(self).items()}

    @classmethod
    def of_json(cls, data: Mapping[str, Any]) -> Calibration:
        return cls(**data)


def calibrate() -> Calibration:
    """Measures in a process of its own, for about two seconds."""
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    return Calibration.of_json(json.loads(done.stdout))


def measured() -> Calibration:
    """Measures in this process."""
    cold, warm = _copies()
    return Calibration(cold, warm, _arithmetic(1), _arithmetic(2))


def _copies(runs: int = 3) -> tuple[list[float], list[float]]:
    """GB a second of copies into new memory, and once more into the same."""
    import numpy as np

    source = np.ones(COPIED, np.uint8)
    cold, warm = [], []
    for _ in range(runs):
        target = np.empty_like(source)  # so large an array gets pages of its own, which the system takes back with it
        for speeds in (cold, warm):
            speeds.append(COPIED / _seconds(lambda target=target: np.copyto(target, source)) / 1e9)
        del target
    return cold, warm


def _arithmetic(threads: int, runs: int = 3) -> list[float]:
    """GFLOP/s of so many threads that compute at once."""
    import numba
    import numpy as np

    @numba.njit("void(float32[::1], float32[::1])", nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
    def polynomial(numbers: Any, sums: Any) -> None:
        for _ in range(TIMES):
            for i in range(NUMBERS):
                x = numbers[i]
                y = np.float32(1)
                for _ in range(DEGREE):
                    y = y * x + np.float32(0.5)
                sums[i] += y

    inputs = [(np.linspace(0, 0.5, NUMBERS, dtype=np.float32), np.zeros(NUMBERS, np.float32)) for _ in range(threads)]
    operations = threads * TIMES * NUMBERS * (2 * DEGREE + 1)
    with ThreadPoolExecutor(threads) as pool:

        def work() -> None:
            list(pool.map(lambda arrays: polynomial(*arrays), inputs))

        work()
        return [operations / _seconds(work) / 1e9 for _ in range(runs)]


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.path.remove(str(Path(__file__).resolve().parent))  # where modules have names of others
    print(json.dumps(measured().as_json()))
