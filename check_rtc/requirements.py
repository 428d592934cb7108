"""The table of requirements: what the contract says, where, what a check moves."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Final


class Outcome(StrEnum):
    """Outcome of one check."""

    OK = "ok"
    """As the contract says."""

    WRONG = "WRONG"
    """Otherwise than the contract says."""

    SEEN = "seen"
    """Allowed, and still worth a look."""

    SKIPPED = "skipped"
    """Not looked at; the text says why."""


class Moves(StrEnum):
    """The part of the telescope that a check moves."""

    NOTHING = "nothing"
    """It listens, and reads the matrix in use."""

    WORDS = "words"
    """It asks what must be refused, and moves nothing."""

    MATRIX = "matrix"
    """It sends the matrix in use again, under new ids: other names for the same numbers."""

    MIRROR = "mirror"
    """It plays a small dither."""

    LOOP = "loop"
    """It opens the loop for some seconds, and closes it again."""

    IMAGE = "image"
    """It has the mirror's image moved on the sensor, and back."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """One requirement of the contract."""

    says: str
    """In a line."""

    anchor: str
    """Of the section of docs/rtc.md."""

    moves: Moves = Moves.NOTHING


REQUIREMENTS: Final[dict[str, Requirement]] = {
    "connection": Requirement("the token alive/rtc is there, and stays", "connection"),
    "messages": Requirement("every message is as its table says", "messages"),
    "frames": Requirement(
        "frames come at the rate that status and dt_ns say, 10 to 100 messages a second", "frames"
    ),
    "sizes": Requirement(
        "slopes and modes of a frame are those of the status, and stay so", "frames"
    ),
    "numbers": Requirement("every number is finite, and slopes are new ones", "frames"),
    "sequence": Requirement(
        "each frame comes once, none is lost, seq0 never goes back", "sessions-sequence-time"
    ),
    "clock": Requirement("t0_ns goes on by dt_ns a frame", "sessions-sequence-time"),
    "delivery": Requirement("a batch is sent when its last frame is there", "timing"),
    "session": Requirement(
        "one session, until the RTC or its integrator starts over", "sessions-sequence-time"
    ),
    "status": Requirement("a status 1 to 10 times a second, that agrees with the frames", "status"),
    "images": Requirement(
        "the pupil images in the flux of the status lie where the instrument file has them",
        "status",
    ),
    "ids": Requirement(
        "one basis and one configuration, in frames, status and manifest",
        "slopes-commands-orientation",
    ),
    "matrix": Requirement(
        "rtc/cm/applied answers with manifest and parts of the matrix in use", "reconstructors"
    ),
    "law": Requirement("leak, gain and delay of the frames are those of the status", "the-loop"),
    "obedience": Requirement("every mode does what the loop asks of it", "the-loop"),
    "orientation": Requirement(
        "sign, order, axes and unit are those of the instrument file", "slopes-commands-orientation"
    ),
    "late-join": Requirement(
        "cm/current is asked once a session, when alive/service appears", "reconstructors"
    ),
    "replies": Requirement(
        "a reply within 1 s to everything, refusals with their word, once for each id",
        "commands",
        Moves.WORDS,
    ),
    "signatures": Requirement(
        "with a shared secret, what is not signed, changed or sent before is refused",
        "signatures",
        Moves.WORDS,
    ),
    "dither": Requirement(
        "a dither begins at start_seq as asked for, is in the status, and stops on request",
        "dither",
        Moves.MIRROR,
    ),
    "columns": Requirement(
        "row k holds the slopes and the command of one exposure, of the matrix's sign",
        "frames",
        Moves.MIRROR,
    ),
    "commit": Requirement(
        "a matrix is applied within 2 s of its commit, from the frame acknowledged",
        "reconstructors",
        Moves.MATRIX,
    ),
    "chunks": Requirement(
        "a commit may overtake its chunks; what is missing after 2 s is asked for",
        "reconstructors",
        Moves.MATRIX,
    ),
    "rejection": Requirement(
        "a wrong sum, basis or manifest and a used id are rejected, a repeat answered again",
        "reconstructors",
        Moves.MATRIX,
    ),
    "reconnect": Requirement(
        "the RTC comes back after the router was away, in the same session",
        "connection",
        Moves.WORDS,
    ),
    "loop": Requirement(
        "opening zeroes the integrator in a new session; closing goes on in it; the matrix "
        "survives",
        "loop",
        Moves.LOOP,
    ),
    "measure": Requirement(
        "a measured matrix comes in slope per metre; the loop is closed again",
        "measure",
        Moves.LOOP,
    ),
    "offload": Requirement(
        "a demand moves the image as asked for, once, and stands still from start_seq on",
        "offload",
        Moves.IMAGE,
    ),
}
"""By name, in the order in which they are told."""


@dataclass(frozen=True, slots=True)
class Checked:
    """One check that was made."""

    outcome: Outcome
    name: str
    """Of its article."""

    found: str
    """Or why it was not made."""

    @property
    def requirement(self) -> Requirement:
        """The requirement that was checked."""
        return REQUIREMENTS[self.name]


fine = partial(Checked, Outcome.OK)
wrong = partial(Checked, Outcome.WRONG)
seen = partial(Checked, Outcome.SEEN)
skipped = partial(Checked, Outcome.SKIPPED)
"""A check by its name, and what was found."""
