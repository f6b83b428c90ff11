"""One module a sub-command: parse, one library call, report."""
