"""Fuzzers: inputs that nobody would make on purpose, and laws that hold for whatever comes of them. See docs/fuzzing.md."""
