"""The exception tree of pyrcal.

::

    PyrcalError
    ├── ConfigurationError   a settings or instrument file that cannot be used
    ├── ModelError           numbers the optical model cannot work with
    ├── MatrixError          a measured interaction matrix that cannot be used
    ├── WireError            bytes from the RTC that break the contract
    ├── LinkError            the zenoh session cannot be opened or an RTC does not answer
    ├── CommandError         an operator's request that cannot be carried out now
    │   ├── UnknownIdError   an unknown reconstructor, session or product
    │   ├── StaleError       what it was decided on has changed since
    │   ├── UntaggedError    strictness was asked for, and not what it was decided on
    │   ├── TooLargeError    a request or an upload beyond the limit
    │   ├── TooSlowError     a request or an upload that does not come in time
    │   └── BusyError        too much under way already: try again later
    ├── WorkerError          the worker process died; the job is lost, the service is not
    ├── ClusterError         the Dask cluster is not there, is gone, or runs another version
    └── ArchiveError         a product that cannot be written, read, or fails its checksum
        └── StorageError     the disk refuses: full, gone, or not to be written

Expected outcomes (a rejected fit, a refused reconstructor, too few frames) are values, not
exceptions: their text tells the operator what to do.

Such texts quote what strangers have written, so they reach a terminal as :func:`shown` has it.
"""

import sys
import unicodedata

_UNSEEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Categories of characters that move a cursor, turn the writing round, or have no shape."""


def shown(text: str, keep: str = "") -> str:
    """Return a text as a terminal may have it: control characters are written out.

    Characters in ``keep`` stay: the ends of a program's own lines.
    """
    if text.isprintable():
        return text
    return "".join(
        character
        if character in keep or unicodedata.category(character) not in _UNSEEN
        else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def say(line: str) -> None:
    """Write a line to standard error, beside the answer."""
    sys.stderr.write(f"{shown(line)}\n")


class PyrcalError(Exception):
    """Anything pyrcal raises on purpose; the message says what was found and what was expected."""


class ConfigurationError(PyrcalError):
    """A settings or instrument file cannot be used; the message names the file and the key."""

    def __init__(self, message: str, problems: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.problems = problems or (message,)
        """Everything that is wrong, one line each."""


class ModelError(PyrcalError):
    """The optical model was given numbers it cannot work with."""


class MatrixError(PyrcalError):
    """A measured interaction matrix cannot be used; the message names the file and the array."""


class WireError(PyrcalError):
    """A message from the RTC breaks the wire contract and was not used."""


class LinkError(PyrcalError):
    """The zenoh session cannot be opened, or the RTC did not answer."""


class CommandError(PyrcalError):
    """An operator's request cannot be carried out in the present state."""


class UnknownIdError(CommandError):
    """The id names nothing this service knows."""


class StaleError(CommandError):
    """The subject of the order has changed since it was shown."""


class UntaggedError(CommandError):
    """An order asks for strictness without an ETag of its subject."""


class TooLargeError(CommandError):
    """A request or an upload is larger than this service takes."""


class TooSlowError(CommandError):
    """A request or an upload does not come in time."""


class BusyError(CommandError):
    """Too much of the same kind is under way; the same request may be granted later."""


class WorkerError(PyrcalError):
    """The worker process died with a job in its hands."""


class ClusterError(PyrcalError):
    """The Dask cluster is not there, is gone, or runs another version; work can be done here."""


class ArchiveError(PyrcalError):
    """A product cannot be written or read, or its checksum does not match."""


class StorageError(ArchiveError):
    """The disk refuses to be written; the message names the path and what the system says."""
