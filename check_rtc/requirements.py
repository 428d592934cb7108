"""Requirements of the contract that are checked, and the results of checks.

:data:`REQUIREMENTS` names each requirement, its section in docs/rtc.md, and the part of the
telescope that its check moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final


class Outcome(StrEnum):
    """Outcome of one check."""

    OK = "ok"
    """The requirement is met."""

    WRONG = "WRONG"
    """The contract is broken."""

    SEEN = "seen"
    """Allowed by the contract, but unusual."""

    SKIPPED = "skipped"
    """Not checked; the text gives the reason."""


class Moves(StrEnum):
    """Part of the telescope that a check moves."""

    NOTHING = "nothing"
    """The check listens, and reads the matrix in use."""

    WORDS = "words"
    """The check sends commands that must be refused, and moves nothing."""

    MATRIX = "matrix"
    """The check sends the numbers of the matrix in use again, most under new ids."""

    MIRROR = "mirror"
    """The check plays a small dither."""

    REFERENCES = "references"
    """The check subtracts an offset from the slopes that the matrix in use does not see."""

    LOOP = "loop"
    """The check opens the loop for some seconds and closes it again."""

    IMAGE = "image"
    """The check moves the mirror's image on the sensor, and back."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirements of one section of the contract that one check verifies."""

    numbers: tuple[int, ...]
    """Numbers of the requirements in docs/rtc.md: 4 is R-4."""

    says: str
    """Summary of the requirements, one line."""

    anchor: str
    """Anchor of their section in docs/rtc.md."""

    moves: Moves = Moves.NOTHING

    @property
    def labels(self) -> tuple[str, ...]:
        """Requirements as docs/rtc.md names them, such as R-4."""
        return tuple(f"R-{number}" for number in self.numbers)


REQUIREMENTS: Final[dict[str, Requirement]] = {
    "connection": Requirement((4,), "the token alive/rtc is declared and stays", "connection"),
    "messages": Requirement((7, 8, 9, 11, 12), "every message agrees with its table", "messages"),
    "frames": Requirement(
        (19, 20),
        "frames come at the rate that status and dt_ns report, 10 to 100 messages a second",
        "frames",
    ),
    "sizes": Requirement(
        (15,), "the sizes of frames are those of the status and constant", "frames"
    ),
    "numbers": Requirement(
        (21,), "all numbers are finite, and slopes change with each frame", "frames"
    ),
    "sequence": Requirement(
        (25,), "each frame comes once, none is lost, seq0 never decreases", "sessions-sequence-time"
    ),
    "clock": Requirement(
        (26,), "t0_ns is UTC and increases by dt_ns per frame", "sessions-sequence-time"
    ),
    "delivery": Requirement(
        (19,), "a batch is sent as soon as its last frame is complete", "frames"
    ),
    "session": Requirement(
        (5, 22, 23),
        "one session, until the RTC restarts or resets its integrator",
        "sessions-sequence-time",
    ),
    "status": Requirement(
        (36, 37, 38), "a status 1 to 10 times a second that agrees with the frames", "status"
    ),
    "images": Requirement(
        (41,),
        "the pupil images in the flux of the status are where the instrument file says",
        "status",
    ),
    "ids": Requirement(
        (31, 82),
        "one basis and one configuration, in frames, status and manifest; references have the same "
        "name in frames and status",
        "slopes-commands-orientation",
    ),
    "matrix": Requirement(
        (39, 75),
        "rtc/cm/applied answers with manifest and chunks of the matrix in use",
        "reconstructors",
    ),
    "law": Requirement(
        (14, 16, 32, 35), "leak, gain and delay in the frames are those of the status", "the-loop"
    ),
    "obedience": Requirement((33,), "every mode follows the commands of the loop", "the-loop"),
    "orientation": Requirement(
        (28, 29, 30),
        "sign, order, axes and unit are those of the instrument file",
        "slopes-commands-orientation",
    ),
    "late-join": Requirement(
        (74,), "cm/current is queried once a session, when alive/service appears", "reconstructors"
    ),
    "replies": Requirement(
        (42, 43, 44, 49, 87),
        "every command has a reply within 1 s, refusals begin with their code, and a repeated id "
        "has the same reply",
        "commands",
        Moves.WORDS,
    ),
    "signatures": Requirement(
        (79, 81),
        "with a shared secret, unsigned, modified and replayed commands are refused",
        "signatures",
        Moves.WORDS,
    ),
    "dither": Requirement(
        (17, 40, 44, 45, 46, 50),
        "a dither begins at start_seq as requested, is in the status, stops on request, and is "
        "played once, however often its id comes",
        "dither",
        Moves.MIRROR,
    ),
    "columns": Requirement(
        (13, 14),
        "row k has slopes and total command of the same exposure, with the sign of the matrix",
        "frames",
        Moves.MIRROR,
    ),
    "commit": Requirement(
        (18, 67, 68, 69, 70, 75),
        "a matrix is applied within 2 s of its commit, from the frame acknowledged, and can then "
        "be read back",
        "reconstructors",
        Moves.MATRIX,
    ),
    "chunks": Requirement(
        (65,),
        "a commit may come before its chunks; chunks that are missing after 2 s are queried",
        "reconstructors",
        Moves.MATRIX,
    ),
    "rejection": Requirement(
        (11, 53, 66, 71, 72),
        "a wrong checksum, shape, basis or manifest and a used id are rejected, and a repeated "
        "commit is acknowledged again",
        "reconstructors",
        Moves.MATRIX,
    ),
    "references": Requirement(
        (83, 84, 85, 86),
        "an offset of the reference slopes is subtracted after a ramp, named in frames and status, "
        "and read back; session, gains and matrix stay",
        "references",
        Moves.REFERENCES,
    ),
    "reconnect": Requirement(
        (1, 23),
        "the RTC reconnects after the router was away, in the same session",
        "connection",
        Moves.WORDS,
    ),
    "loop": Requirement(
        (22, 51, 52),
        "opening the loop begins a session with a zero integrator; closing continues it; the "
        "matrix stays in use",
        "loop",
        Moves.LOOP,
    ),
    "finite": Requirement(
        (66,),
        "a matrix with a number that is not finite is rejected, with the loop open",
        "reconstructors",
        Moves.LOOP,
    ),
    "measure": Requirement(
        (56, 57, 58),
        "a measured matrix is in slope per metre, and the loop is closed again",
        "measure",
        Moves.LOOP,
    ),
    "offload": Requirement(
        (45, 61, 62, 63),
        "a demand moves the image as requested, once, and it is still from start_seq on",
        "offload",
        Moves.IMAGE,
    ),
}
"""Requirements by the name of their check, in the order of the report."""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check."""

    outcome: Outcome
    name: str
    """Name of the check in :data:`REQUIREMENTS`."""

    found: str
    """Finding, or the reason for which the check was skipped."""

    @property
    def requirement(self) -> Requirement:
        """Requirement that was checked."""
        return REQUIREMENTS[self.name]


fine = partial(CheckResult, Outcome.OK)
wrong = partial(CheckResult, Outcome.WRONG)
seen = partial(CheckResult, Outcome.SEEN)
skipped = partial(CheckResult, Outcome.SKIPPED)
"""Constructors of results from the name of a check and its finding."""
