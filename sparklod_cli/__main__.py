"""`python -m sparklod_cli`."""

import os
import sys

# Python searches the current folder first, which may be somebody else's. It stays where the package itself is in it.
# Without pathlib, which would be looked for there, too; os and sys are loaded already.
_here = os.getcwd()  # noqa: PTH109
if sys.path[:1] == [_here] and not __file__.startswith(_here + os.sep):
    del sys.path[0]

from .cli import main  # noqa: E402

main()
