"""Encodings of splats and trees in the memory of Spark's shaders."""
