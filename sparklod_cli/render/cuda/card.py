"""The card: whether there is one that can be used, and arrays and sums on it."""

from __future__ import annotations

import contextlib
import importlib.util
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...system.errors import BackendError, optional_import
from ...system.jit import load_compiler

#: An array on the card, as numba has it.
CardArray = Any

#: Oldest driver, by the version of CUDA that it supports: that of the libraries in the extra `cuda`.
LEAST_DRIVER = (12, 0)

#: Oldest compute capability that CUDA 12 compiles for.
LEAST_CAPABILITY = (5, 0)


@dataclass(frozen=True)
class Card:
    """A card."""

    name: str  # for display
    memory: int  # bytes
    free: int  # bytes
    driver: tuple[int, int]  # version of CUDA that its driver supports
    sorter: str  # "cupy", or "numpy" where arrays are sorted by the processor, which is slow

    def __str__(self) -> str:
        return f"{self.name} ({self.memory / 1e9:.0f} GB, CUDA {self.driver[0]}.{self.driver[1]})"


def find_card() -> Card:
    """Return the card that numba uses; a BackendError says in one line why none can be used."""
    load_compiler()
    with optional_import("--device cuda needs numba-cuda", "cuda", BackendError):
        from numba import cuda
    from ...system.jit_cuda import SIMULATED

    if SIMULATED:
        return Card("numba's simulator", 0, 0, LEAST_DRIVER, "numpy")
    try:
        driver = tuple(cuda.current_context().device.compute_capability), cuda.cudadrv.driver.driver.get_version()
    except Exception as error:  # numba has no common class for errors of drivers
        lines = str(error).split()
        raise BackendError(f"no usable NVIDIA card and driver ({' '.join(lines)})") from None
    capability, version = driver
    if tuple(version) < LEAST_DRIVER:
        raise BackendError(f"the NVIDIA driver supports CUDA {version[0]}.{version[1]}; install one for CUDA 12")
    if capability < LEAST_CAPABILITY:
        raise BackendError(f"the NVIDIA card has compute capability {capability[0]}.{capability[1]}; it takes 5.0")
    if not cuda.is_available():
        with optional_import("--device cuda needs NVVM, which compiles its kernels", "cuda", BackendError):
            raise ImportError("NVVM is missing")
    context = cuda.current_context()
    name = context.device.name
    free, total = context.get_memory_info()
    return Card(name.decode() if isinstance(name, bytes) else name, total, free, tuple(version), _sorter())


def _sorter() -> str:
    return "cupy" if importlib.util.find_spec("cupy") else "numpy"


def print_card() -> None:
    """Print the card and versions of packages; exit with the reason if no card can be used."""
    from importlib import metadata

    try:
        card = find_card()
    except BackendError as error:
        raise SystemExit(str(error)) from None
    versions = [f"{name} {metadata.version(name)}" for name in ("numba", "numba-cuda")]
    print(f"{card}, {card.free / 1e9:.1f} GB are free; {', '.join(versions)}; arrays are sorted by {card.sorter}")


class _TooLargeError(Exception):
    """An array does not fit into the memory of the card; `share` is that memory over what is in use with the array."""

    def __init__(self, share: float) -> None:
        super().__init__(share)
        self.share = share


def _is_of_memory(error: Exception) -> bool:
    """Return True if an error of numba or cupy says that the memory of the card does not suffice."""
    return "OUT_OF_MEMORY" in str(error) or type(error).__name__ == "OutOfMemoryError"


@contextlib.contextmanager
def card_errors(splats: int) -> Iterator[None]:
    """Turn errors of the card inside into `BackendError`; if memory does not suffice, it names how many splats fit.

    Memory is proportional to the number of splats that are drawn or fitted, but for pixels.
    """
    try:
        yield
    except BackendError:
        raise
    except Exception as error:
        kind = type(error).__name__
        if isinstance(error, _TooLargeError) or _is_of_memory(error):
            share = getattr(error, "share", None)
            fit = "fewer" if share is None else f"about {float(f'{splats * share:.2g}'):,.0f}"
            advice = f"{fit} fit, or use --device cpu"
            raise BackendError(f"the card has too little memory for {splats:,} splats; {advice}") from None
        if kind in ("CudaAPIError", "CudaDriverError", "CudaSupportError", "CUDARuntimeError", "NvvmError"):
            raise BackendError(f"the card failed ({' '.join(str(error).split())}); use --device cpu") from None
        raise


def to_card(array: NDArray[Any]) -> CardArray:
    """Copy an array to the card."""
    copy = on_card(array.shape, array.dtype)
    if array.size:
        copy.copy_to_device(np.ascontiguousarray(array))
    return copy


def on_card(shape: int | tuple[int, ...], dtype: Any = np.float32) -> CardArray:
    """Return an array on the card whose values are undefined."""
    from numba import cuda

    try:
        return cuda.device_array(shape, dtype)
    except Exception as error:
        if not _is_of_memory(error):
            raise
        free, total = cuda.current_context().get_memory_info()
        raise _TooLargeError(total / (total - free + np.prod(shape) * np.dtype(dtype).itemsize)) from None


class CardMemory:
    """Arrays on the card that are used again for every picture, as allocating them would take longer than drawing."""

    def __init__(self) -> None:
        self._flat: dict[str, CardArray] = {}

    def array(self, name: str, shape: int | tuple[int, ...], dtype: Any = np.float32) -> CardArray:
        """Return an array of undefined values; the next one of that name overwrites it."""
        shape = shape if isinstance(shape, tuple) else (shape,)
        size = math.prod(shape)
        if not size:
            return on_card(shape, dtype)
        if name not in self._flat or self._flat[name].shape[0] < size:
            self._flat.pop(name, None)  # before the larger one is allocated
            self._flat[name] = on_card(size + size // 4, dtype)
        return self._flat[name][:size].reshape(shape)


def sort(array: CardArray) -> None:
    """Sort a uint64 array on the card in place."""
    if not _use_cupy():
        array.copy_to_device(np.sort(array.copy_to_host()))
        return
    import cupy

    cupy.asarray(array).sort()


def add_up(array: CardArray) -> int:
    """Replace an int64 array on the card by its running sums; return the last."""
    if not array.shape[0]:
        return 0
    if not _use_cupy():
        sums = np.cumsum(array.copy_to_host())
        array.copy_to_device(sums)
        return int(sums[-1])
    import cupy

    view = cupy.asarray(array)
    cupy.cumsum(view, out=view)
    return int(view[-1])


def _use_cupy() -> bool:
    from ...system.jit_cuda import SIMULATED

    return not SIMULATED and _sorter() == "cupy"
