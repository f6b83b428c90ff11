"""Compiled inner loops of the codecs."""
