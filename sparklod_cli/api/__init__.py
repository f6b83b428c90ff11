"""What `sparklod_cli` hands on as its public functions, and whole-file jobs of the commands beside them.

Every function takes `threads` (None for all processors) and `progress` (see `progress.Told`) where that means
something.
"""
