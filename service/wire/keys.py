"""zenoh key expressions of the contract, ids of messages, and encodings."""

from __future__ import annotations

import re
from enum import StrEnum

from service.errors import WireError

ID_PATTERN = re.compile(r"[A-Za-z0-9._-]{1,64}")
ID_EXPECTED = "1 to 64 of A-Z a-z 0-9 . _ -"
RESERVED_IDS = frozenset({"ack", "current"})
"""Words that cannot be ids, because ``cm/ack`` and ``cm/current`` are keys of their own."""


def validate_id(value: object, where: str) -> str:
    """Return ``value`` if it is a valid id and therefore safe in a key or a file name.

    Raises
    ------
    WireError
        If it is not 1 to 64 of ``A-Z a-z 0-9 . _ -``, or is a reserved word.
    """
    if not isinstance(value, str) or ID_PATTERN.fullmatch(value) is None:
        raise WireError(f"id: {value!r:.80} in {where}, expected {ID_EXPECTED}")
    if value in RESERVED_IDS:
        raise WireError(f"id: {value!r} in {where} is reserved")
    return value


class Role(StrEnum):
    """Sides of the link that hold a liveliness token."""

    RTC = "rtc"
    SERVICE = "service"


class Encodings(StrEnum):
    """zenoh encodings of the messages; informative only."""

    FRAMES = "application/octet-stream;ao.v1.frames"
    BYTES = "application/octet-stream"
    STATUS = "application/msgpack;ao.v1.status"
    COMMIT = "application/msgpack;ao.v1.commit"
    ACKNOWLEDGEMENT = "application/msgpack;ao.v1.ack"
    COMMAND = "application/msgpack;ao.v1.command"
    REPLY = "application/msgpack;ao.v1.reply"
    REFERENCES = "application/msgpack;ao.v1.references"
    MEASURED_COMMIT = "application/msgpack;ao.v1.im-commit"
    STATE = "application/msgpack;ao.v1.state"
    ALARM = "application/msgpack;ao.v1.alarm"
    GAINS = "application/msgpack;ao.v1.gains"


class Keys:
    """Key expressions of one system, all below ``ao/v1/{system}``."""

    def __init__(self, system: str) -> None:
        self.system = validate_id(system, "the name of the system")
        self.root = f"ao/v1/{system}"
        self.frames = f"{self.root}/tel/frames"
        """Telemetry frames."""
        self.status = f"{self.root}/tel/status"
        """Status messages of the RTC."""
        self.all_matrices = f"{self.root}/cm/*"
        """Every :meth:`matrix`, and :attr:`current`."""
        self.all_chunks = f"{self.root}/cm/*/chunk/*"
        """Every :meth:`chunk`."""
        self.all_commits = f"{self.root}/cm/*/commit"
        """Every :meth:`commit`."""
        self.current = f"{self.root}/cm/current"
        """Queryable: the manifest of the reconstructor the RTC should be using."""
        self.acknowledgement = f"{self.root}/cm/ack"
        """Acknowledgements of reconstructors."""
        self.applied = f"{self.root}/rtc/cm/applied"
        """Queryable of the RTC: the matrix in use."""
        self.references_in_use = f"{self.root}/rtc/references"
        """Queryable of the RTC: the offset of its reference slopes."""
        self.references = f"{self.root}/references"
        """Reference slopes that the RTC should use, for programs that apply them in its place."""
        self.all_measured = f"{self.root}/im/**"
        """Every :meth:`measured_chunk` and :meth:`measured_commit`."""
        self.state = f"{self.root}/state"
        """State messages of the service, for all subscribers."""
        self.alarm = f"{self.root}/alarm"
        """Alarms of the service, for all subscribers."""
        self.gains = f"{self.root}/gains"
        """Optical gains of all modes, for all subscribers."""
        self.all_ranks = f"{self.root}/alive/{Role.SERVICE}/*"
        """Every :meth:`rank`."""

    def chunk(self, matrix_id: str, index: int) -> str:
        """Part ``index`` of a reconstructor."""
        return f"{self.matrix(matrix_id)}/chunk/{index}"

    def commit(self, matrix_id: str) -> str:
        """Manifest of a reconstructor: the order to stage and swap."""
        return f"{self.matrix(matrix_id)}/commit"

    def matrix(self, matrix_id: str) -> str:
        """Queryable of one reconstructor: its manifest, or with ``?chunk=k`` its bytes."""
        return f"{self.root}/cm/{validate_id(matrix_id, 'a matrix key')}"

    def command(self, kind: str) -> str:
        """Queryable of the RTC: commands of this :class:`~service.wire.CommandKind`."""
        return f"{self.root}/cmd/rtc/{kind}"

    def measured_chunk(self, matrix_id: str, index: int) -> str:
        """Part ``index`` of a measured interaction matrix."""
        return f"{self.root}/im/{validate_id(matrix_id, 'a matrix key')}/chunk/{index}"

    def measured_commit(self, matrix_id: str) -> str:
        """Manifest of a measured interaction matrix."""
        return f"{self.root}/im/{validate_id(matrix_id, 'a matrix key')}/commit"

    def alive(self, role: Role) -> str:
        """Liveliness token of one side."""
        return f"{self.root}/alive/{role}"

    @staticmethod
    def all_alive(role: Role) -> str:
        """Liveliness tokens of one side in every system."""
        return f"ao/v1/*/alive/{role}"

    @staticmethod
    def system_of(key: str) -> str:
        """Return the system that a key belongs to."""
        return key.split("/")[2]

    def rank(self, name: str) -> str:
        """Liveliness token of one of several services; ``name`` begins with its starting time."""
        return f"{self.root}/alive/{Role.SERVICE}/{name}"

    def matrix_id_of(self, key: str) -> str:
        """Return the id in the key of a matrix, a chunk or a commit, below ``cm`` or ``im``.

        Raises
        ------
        WireError
            If it is another key, or the id in it is invalid.
        """
        return validate_id(self._parts(key)[0], key)

    def chunk_index_of(self, key: str) -> int | None:
        """Return k of ``.../chunk/{k}``; None for any other key of a matrix.

        Raises
        ------
        WireError
            If k is not a decimal number.
        """
        parts = self._parts(key)
        if len(parts) != 3 or parts[1] != "chunk":
            return None
        return parse_chunk_index(parts[2], key)

    def _parts(self, key: str) -> list[str]:
        for branch in ("cm", "im"):
            prefix = f"{self.root}/{branch}/"
            if key.startswith(prefix):
                return key.removeprefix(prefix).split("/")
        raise WireError(f"id: {key!r:.120} is no key of a matrix of {self.root}")


def parse_chunk_index(text: str, where: str) -> int:
    """Return the number of a chunk from the text in a key or a query.

    Raises
    ------
    WireError
        If ``text`` is not a plain decimal number of at most 6 digits.
    """
    # str.isdigit() accepts digits of other scripts, and int() of a long text takes quadratic time.
    if not (text.isascii() and text.isdigit() and len(text) <= 6):
        raise WireError(f"range: chunk {text!r:.40} in {where}, expected a number from 0 on")
    return int(text)
