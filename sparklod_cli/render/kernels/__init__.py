"""Compiled inner loops of the rasterizer."""
