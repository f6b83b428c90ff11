"""What everything else stands on: errors, defaults, units, compiled kernels, threads, progress."""
