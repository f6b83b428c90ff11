"""Defaults of cameras. Imports nothing, so that `--help` stays fast."""

#: Elevation in degrees, above their target, of the cameras of an orbit, a dolly and the overview.
ELEVATION = 15.0

#: How many cameras an orbit has.
ORBIT = 60
