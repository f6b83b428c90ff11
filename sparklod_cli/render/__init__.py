"""Renderers, their settings and colour scales."""
