"""The errors that sparklod raises on purpose. The command line turns each into one line and an exit code."""


class SparklodError(Exception):
    """Base of every error that tells the user something; its text is one line that says what to do."""


class FormatError(SparklodError):
    """A file is not what its format says, or beyond the format's limits. Its subclasses tell a validator more."""

    code = "container.corrupt"


class UnreadableError(FormatError):
    """A file cannot be opened, or is empty."""

    code = "file.unreadable"


class UnknownFormatError(FormatError):
    """A file is of no known format."""

    code = "file.format"


class NotSplatsError(FormatError):
    """A file is of a known format, but holds something else than splats."""

    code = "file.not-splats"


class TruncatedError(FormatError):
    """A file ends before what it promises."""

    code = "container.cut-short"


class PromiseError(FormatError):
    """A header promises more than a file of its size can hold."""

    code = "container.promise"


class VersionError(FormatError):
    """A version, level or degree that the format does not have."""

    code = "container.version"


class ChecksumError(FormatError):
    """A checksum does not match."""

    code = "container.checksum"


class MembersError(FormatError):
    """Compressed data go on in a second gzip member, which not every reader looks at."""

    code = "container.members"


class TooLongError(FormatError):
    """A stream is longer than the header promises."""

    code = "container.too-long"


class InvalidSplatsError(SparklodError):
    """The splats themselves cannot be used: none is left, or some are not finite."""


class TreeError(SparklodError):
    """A Level-of-Detail tree breaks one of its invariants."""


class OutputError(SparklodError):
    """An output cannot be written: it exists already, or the file system refused it."""


class CameraPathError(SparklodError):
    """A camera path cannot be read or made: its file is broken or of no known format, or a camera makes no sense."""


class TooManyCamerasError(CameraPathError):
    """A path has more cameras than are made, or taken."""
