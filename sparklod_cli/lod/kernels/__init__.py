"""Compiled inner loops of the builders, the traversal and inspection: arrays, or NamedTuples of them, in and out."""
