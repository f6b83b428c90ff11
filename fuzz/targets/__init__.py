"""What is fuzzed: a module a target, see `fuzz.case.Target`."""
