"""What every other part may use: errors, units, progress, compiled kernels, and what the machine has."""
