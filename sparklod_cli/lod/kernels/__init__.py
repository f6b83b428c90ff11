"""Compiled inner loops of the builders, the traversal and inspection: arrays, or NamedTuples of them, in and out.

A kernel's decorator states the element types of its arrays (`f4` is float32, `u4` uint32, ...), and `out` the arrays
that it fills or changes; docstrings add shapes, units and what the names do not say. Kernels with `ranges=True` process
rows `start` to `stop`, or `begin` to `end`, on each thread.
"""
