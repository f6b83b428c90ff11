"""The public functions of `sparklod_cli`, and the jobs of its commands: `jobs`, `bake_jobs`, `inspect_jobs`, `viewing`.

Functions that do long work take `threads` (None for all processors) and `progress` (see `arguments.ProgressLike`).
"""
