"""Tables: columns, files, statistics, assertions."""
