"""Exceptions of pyrcal, and texts that are safe to print on a terminal.

::

    PyrcalError
    ├── ConfigurationError   a settings or instrument file that cannot be used
    ├── ModelError           numbers the optical model cannot work with
    ├── MatrixError          a measured interaction matrix that cannot be used
    ├── WireError            bytes from the RTC that break the contract
    ├── LinkError            the zenoh session cannot be opened or an RTC does not answer
    ├── CommandError         an operator's request that cannot be carried out now
    │   ├── UnknownIdError   an unknown reconstructor, session or product
    │   ├── StaleError       the subject of the request has changed since it was read
    │   ├── UntaggedError    a conditional request without the ETag of its subject
    │   ├── TooLargeError    a request or an upload beyond the limit
    │   ├── TooSlowError     a request or an upload that does not come in time
    │   └── BusyError        too many requests of the same kind: try again later
    ├── WorkerError          the worker process died; the job is lost, the service is not
    ├── ClusterError         the Dask cluster is missing, lost, or runs another version
    └── ArchiveError         a product that cannot be written, read, or fails its checksum
        └── StorageError     the disk is full, missing, or not writable

Expected outcomes (a rejected fit, a refused reconstructor, too few frames) are values, not
exceptions; their text says what the operator should do.

Texts may quote names from files and messages of other programs. :func:`shown` escapes control
characters in them before they are printed.
"""

import sys
import unicodedata
from collections.abc import Iterable

_UNSAFE_CATEGORIES = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
"""Unicode categories of characters that move the cursor, reverse the text, or are invisible."""


def list_first(things: Iterable[object], most: int, between: str = ", ") -> str:
    """Return the first of some things as text, and how many more there are."""
    words = [str(one) for one in things]
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return between.join(words[:most]) + more


def shown(text: str, keep: str = "") -> str:
    """Return a text that is safe to print, with control characters written as escapes.

    Characters in ``keep`` are not escaped, such as the newlines of a program's own text.
    """
    if text.isprintable():
        return text
    return "".join(
        character
        if character in keep or unicodedata.category(character) not in _UNSAFE_CATEGORIES
        else character.encode("unicode_escape").decode("ascii")
        for character in text
    )


def say(line: str) -> None:
    """Write a line to standard error, which keeps standard output free for results."""
    sys.stderr.write(f"{shown(line)}\n")


class PyrcalError(Exception):
    """Base of all exceptions of pyrcal; the message says what was found and what was expected."""


class ConfigurationError(PyrcalError):
    """A settings or instrument file cannot be used; the message names the file and the key."""

    def __init__(self, message: str, problems: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.problems = problems or (message,)
        """All problems found, one line each."""


class ModelError(PyrcalError):
    """The optical model received numbers for which it is not defined."""


class MatrixError(PyrcalError):
    """A measured interaction matrix cannot be used; the message names the file and the array."""


class WireError(PyrcalError):
    """A message from the RTC breaks the wire contract and was not used."""


class LinkError(PyrcalError):
    """The zenoh session cannot be opened, or the RTC did not answer."""


class CommandError(PyrcalError):
    """An operator's request cannot be carried out in the present state."""


class UnknownIdError(CommandError):
    """No reconstructor, session or product has this id."""


class StaleError(CommandError):
    """The subject of a request has changed since the client read it."""


class UntaggedError(CommandError):
    """A conditional request has no ETag of its subject."""


class TooLargeError(CommandError):
    """A request or an upload is larger than the limit."""


class TooSlowError(CommandError):
    """A request or an upload does not come in time."""


class BusyError(CommandError):
    """Too many requests of the same kind are running; the same request may succeed later."""


class WorkerError(PyrcalError):
    """The worker process died during a job."""


class ClusterError(PyrcalError):
    """The Dask cluster is missing, lost, or runs another version; jobs can run locally."""


class ArchiveError(PyrcalError):
    """A product cannot be written or read, or its checksum does not match."""


class StorageError(ArchiveError):
    """The disk cannot be written; the message has the path and the error of the system."""
