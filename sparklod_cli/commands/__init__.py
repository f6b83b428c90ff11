"""One module a sub-command: parse, one library call, report. Contradicting options raise `click.UsageError`."""
