"""Compiled inner loops of the rasterizer; `lod.kernels` explains their docstrings."""
