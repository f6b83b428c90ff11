"""The errors that sparklod raises on purpose. The command line turns each into one line and an exit code."""


class SparklodError(Exception):
    """Base of every error that tells the user something; its text is one line that says what to do."""


class FormatError(SparklodError):
    """A file is not what its format says: unknown, cut short, corrupt, or beyond the format's limits."""


class InvalidSplatsError(SparklodError):
    """The splats themselves cannot be used: none is left, or some are not finite."""


class TreeError(SparklodError):
    """A Level-of-Detail tree breaks one of its invariants."""


class OutputError(SparklodError):
    """An output cannot be written: it exists already, or the file system refused it."""
