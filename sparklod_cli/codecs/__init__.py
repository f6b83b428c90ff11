"""One module a file format. None imports another; `io` chooses among them by the table in `formats`."""
