"""The threads of parallel kernels: numba's threading layer, which is started without loading numba."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.machinery
import importlib.util
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from .jit_cache import SETTINGS, numba_folder
from .parallel import processors

#: numba's threading layers in the order in which it tries them, and their modules.
LAYERS = {"tbb": "np.ufunc.tbbpool", "omp": "np.ufunc.omppool", "workqueue": "np.ufunc.workqueue"}

#: Variables that have numba choose another layer.
CHOICES = ("NUMBA_THREADING_LAYER", "NUMBA_THREADING_LAYER_PRIORITY")

#: Names of TBB's library, of which numba needs this version at least.
TBB, TBB_VERSION = {"linux": "libtbb.so.12", "darwin": "libtbb.12.dylib", "win32": "tbb12.dll"}, 12060

_lock = threading.RLock()

#: Held while a parallel kernel runs on a layer that is not thread-safe. Reentrant, because a signal handler or a
#: finaliser can call a kernel in the thread that holds it.
_running = threading.RLock()


class Layer:
    """A threading layer whose threads have been started.

    Args:
        name: its name, one of `LAYERS`.
        module: numba's module of it.
        most: the number of threads.
    """

    def __init__(self, name: str, module: Any, most: int) -> None:
        self.name, self.module, self.most = name, module, most
        self._use = ctypes.CFUNCTYPE(None, ctypes.c_int)(module.set_num_threads)
        self._in_use = ctypes.CFUNCTYPE(ctypes.c_int)(module.get_num_threads)

    def launch(self, most: int) -> None:
        """Start the threads, which run kernels of the calling thread, and of threads that set no number."""
        ctypes.CFUNCTYPE(None, ctypes.c_int)(self.module.launch_threads)(most)
        self.most = most
        self.use(most)

    def use(self, count: int) -> None:
        """Has kernels that this thread calls run on `count` threads, or on all if there are fewer.

        Raises:
            ValueError: `count` is less than 1.
        """
        if count < 1:
            raise ValueError(f"kernels cannot run on {count} threads")
        self._use(min(count, self.most))

    def in_use(self) -> int:
        """The number of threads that kernels called by this thread run on."""
        return int(self._in_use())


def layer() -> Layer:
    """The threading layer; starts its threads.

    Raises:
        ValueError: no threading layer can be loaded.
    """
    with _lock:
        return _layer()


@functools.cache
def _layer() -> Layer:
    if "numba" not in sys.modules and not SETTINGS.exists() and not any(map(os.environ.get, CHOICES)):
        for name in LAYERS:
            with contextlib.suppress(ImportError, OSError, ValueError):
                return _started(name)
    from .jit import load_compiler

    layer: Layer = load_compiler().threading_layer()
    return layer


def started() -> Layer | None:
    """The threading layer, if its threads have been started."""
    with _lock:
        return _layer() if _layer.cache_info().currsize else None


def guarded(called: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls a parallel kernel, one at a time where the layer is not thread-safe.

    numba's own layer, workqueue, which is used where neither TBB nor OpenMP is installed, aborts the process if two
    threads run parallel loops at the same time.

    Args:
        called: machine code of a parallel kernel.
    """
    if layer().name != "workqueue":
        return called

    def one_at_a_time(*arguments: Any) -> Any:
        with _running:
            return called(*arguments)

    return one_at_a_time


def _after_fork() -> None:
    """Run kernels on one thread in a forked process, which has none of the threads of its parent.

    GNU's OpenMP would wait for them forever, so numba ends the process; workqueue would crash.
    """
    global _lock, _running
    _lock, _running = threading.RLock(), threading.RLock()  # another thread of the parent may hold them
    layer = started()
    if layer is not None:
        layer.launch(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _started(name: str) -> Layer:
    """Starts a layer, as numba does.

    Raises:
        ImportError, OSError: this layer cannot be loaded.
        ValueError: this layer, or the number of threads asked for, is not one that numba would take.
    """
    if name == "tbb" and ctypes.CDLL(TBB.get(sys.platform, "")).TBB_runtime_interface_version() < TBB_VERSION:
        raise ValueError("TBB is too old")
    most = int(os.environ.get("NUMBA_NUM_THREADS") or processors())
    if most < 1:
        raise ValueError(f"NUMBA_NUM_THREADS is {most}")
    module: Any = extension(LAYERS[name])
    started = Layer(name, module, most)
    started.launch(most)
    return started


def extension(name: str) -> ModuleType:
    """An extension module of numba, loaded without the package.

    If numba is loaded later, it finds this module.

    Args:
        name: its name in the package.

    Raises:
        ImportError: there is none, or it cannot be loaded.
    """
    full = f"numba.{name}"
    folder = numba_folder()
    if full in sys.modules:
        return sys.modules[full]
    if folder is None:
        raise ImportError("numba is not installed")
    for suffix in importlib.machinery.EXTENSION_SUFFIXES:
        path = Path(folder, *name.split(".")).with_suffix(suffix)
        if path.is_file():
            loader = importlib.machinery.ExtensionFileLoader(full, str(path))
            spec = importlib.util.spec_from_loader(full, loader)
            assert spec is not None
            module = importlib.util.module_from_spec(spec)
            loader.exec_module(module)
            return sys.modules.setdefault(full, module)
    raise ImportError(f"numba has no module {name}")
