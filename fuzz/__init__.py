"""Inputs that nobody would make on purpose, and laws that hold for whatever comes of them; see docs/fuzzing.md."""
