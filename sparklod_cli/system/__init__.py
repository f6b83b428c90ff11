"""Foundations of all other packages: errors, defaults, units, compiled kernels, threads, progress."""
