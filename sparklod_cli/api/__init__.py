"""The public functions of `sparklod_cli`, and `jobs`, the library calls of the commands.

Every function takes `threads` (None for all processors) and `progress` (see `arguments.ProgressLike`) where that means
something.
"""
