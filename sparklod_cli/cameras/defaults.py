"""What cameras are where nobody says otherwise; imports nothing, so that `--help` stays quick."""

#: Degrees by which the cameras of an orbit or a dolly, and that of the whole scene, are above what they look at.
ELEVATION = 15.0

#: How many cameras an orbit has.
ORBIT = 60
