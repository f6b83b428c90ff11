"""The targets of the fuzzers, a module each; see `fuzz.case.Target`."""
