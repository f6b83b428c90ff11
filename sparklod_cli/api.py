"""The public Python API; `sparklod_cli` hands it on. Nothing else is promised to stay as it is."""
