"""`python -m sparklod_cli`."""

from .cli import main

main()
