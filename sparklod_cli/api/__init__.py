"""The public functions of `sparklod_cli`, and the jobs of its commands, which are these functions for files.

Functions that do long work take `threads` (None for all processors) and `progress` (see `arguments.ProgressLike`).
"""
