"""Compiled inner loops of the codecs; `lod.kernels` explains their docstrings."""
