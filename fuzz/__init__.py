"""Fuzzers: they make hostile and damaged inputs, and check laws that hold for every input; see docs/fuzzing.md."""
