"""Tests of `sparklod_cli.view` and of the command."""
