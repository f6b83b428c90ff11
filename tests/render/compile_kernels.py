"""Compile every kernel for cards to PTX, for which no card is needed; print a line for each, or what is missing."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace

#: Compute capability: the oldest that CUDA 12 and 13 both compile for.
CAPABILITY = (7, 5)

MODULES = (
    "sparklod_cli.render.cuda.forward",
    "sparklod_cli.render.cuda.card_gradients",
    "sparklod_cli.fitting.cuda.kernels",
)

#: Exit status where NVVM is missing.
MISSING = 77


def main() -> int:
    from numba import cuda
    from numba.cuda import dispatcher

    from sparklod_cli.system.jit_cuda import CudaKernel

    try:
        cuda.compile(lambda: None, (), cc=CAPABILITY, output="ptx")
    except Exception as error:  # its class differs between numba's own CUDA target and numba-cuda
        print(f"NVVM is missing: {' '.join(str(error).split())[:200]}")
        return MISSING
    # numba compiles device functions for the card that is there.
    dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=CAPABILITY)
    for name in MODULES:
        module = importlib.import_module(name)
        for kernel in [value for value in vars(module).values() if isinstance(value, CudaKernel)]:
            text, _ = cuda.compile(
                kernel.dispatcher.py_func, kernel.signature, cc=CAPABILITY, output="ptx", abi="numba"
            )
            print(f"{kernel.__name__}: {len(text.splitlines()):,} lines of PTX, {text.count('.f64'):,} of float64")
    return 0


if __name__ == "__main__":
    sys.exit(main())
