"""What is checked of an RTC: what the contract says, where, and what the check moves."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class Outcome(StrEnum):
    """What came of one check."""

    OK = "ok"
    """As the contract says."""

    WRONG = "WRONG"
    """Otherwise than the contract says."""

    SEEN = "seen"
    """Allowed, and still worth a look."""

    SKIPPED = "skipped"
    """Not looked at; the text says why."""


class Moves(StrEnum):
    """What a check does to the telescope."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Article:
    """One thing the contract asks."""

    says: str
    """In a line."""

    anchor: str
    """Of the section of docs/rtc.md."""

    moves: Moves = Moves.NOTHING


ARTICLES: Final[dict[str, Article]] = {
    "connection": Article(says="the token alive/rtc is there, and stays", anchor="connection"),
    "messages": Article(says="every message is as its table says", anchor="messages"),
    "frames": Article(
        says="frames come at the rate that status and dt_ns tell, 10 to 100 messages a second",
        anchor="frames",
    ),
    "sizes": Article(
        says="slopes and modes of a frame are those of the status, and stay so", anchor="frames"
    ),
    "numbers": Article(says="every number is finite, and slopes are new ones", anchor="frames"),
    "sequence": Article(
        says="each frame comes once, none is lost, seq0 never goes back",
        anchor="sessions-sequence-time",
    ),
    "clock": Article(says="t0_ns goes on by dt_ns a frame", anchor="sessions-sequence-time"),
    "delivery": Article(says="a batch is sent when its last frame is there", anchor="timing"),
    "session": Article(
        says="one session, until the RTC or its integrator starts over",
        anchor="sessions-sequence-time",
    ),
    "status": Article(
        says="a status 1 to 10 times a second, that agrees with the frames", anchor="status"
    ),
    "ids": Article(
        says="one basis and one configuration, in frames, status and manifest",
        anchor="slopes-commands-orientation",
    ),
    "matrix": Article(
        says="rtc/cm/applied answers with manifest and parts of the matrix in use",
        anchor="reconstructors",
    ),
    "law": Article(
        says="leak, gain and delay of the frames are those of the status", anchor="the-loop"
    ),
    "obedience": Article(says="every mode does what the loop asks of it", anchor="the-loop"),
    "orientation": Article(
        says="sign, order, axes and unit are those of the instrument file",
        anchor="slopes-commands-orientation",
    ),
    "late-join": Article(
        says="cm/current is asked once a session, when alive/service appears",
        anchor="reconstructors",
    ),
    "replies": Article(
        says="a reply within 1 s to everything, refusals with their word, once for each id",
        anchor="commands",
        moves=Moves.WORDS,
    ),
    "dither": Article(
        says="a dither begins at start_seq as asked for, is told, and stops when told to",
        anchor="dither",
        moves=Moves.MIRROR,
    ),
    "columns": Article(
        says="row k holds the slopes and the command of one exposure, of the matrix's sign",
        anchor="frames",
        moves=Moves.MIRROR,
    ),
    "commit": Article(
        says="a matrix is applied within 2 s of its commit, from the frame acknowledged",
        anchor="reconstructors",
        moves=Moves.MATRIX,
    ),
    "chunks": Article(
        says="a commit may overtake its chunks; what is missing after 2 s is asked for",
        anchor="reconstructors",
        moves=Moves.MATRIX,
    ),
    "rejection": Article(
        says="a wrong sum, basis or manifest and a used id are rejected, a repeat answered again",
        anchor="reconstructors",
        moves=Moves.MATRIX,
    ),
    "reconnect": Article(
        says="the RTC comes back after the router was away, in the same session",
        anchor="connection",
        moves=Moves.WORDS,
    ),
    "loop": Article(
        says="opening zeroes the integrator in a new session; closing goes on in it; the matrix "
        "survives",
        anchor="loop",
        moves=Moves.LOOP,
    ),
    "measure": Article(
        says="a measured matrix comes in slope per metre; the loop is closed again",
        anchor="measure",
        moves=Moves.LOOP,
    ),
}
"""By name, in the order in which they are told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """One check that was made."""

    name: str
    """Of its article."""

    outcome: Outcome
    found: str

    @property
    def article(self) -> Article:
        """What the contract says."""
        return ARTICLES[self.name]


def fine(name: str, found: str) -> Checked:
    """Return a check that found what the contract says."""
    return Checked(name=name, outcome=Outcome.OK, found=found)


def wrong(name: str, found: str) -> Checked:
    """Return a check that found something else."""
    return Checked(name=name, outcome=Outcome.WRONG, found=found)


def seen(name: str, found: str) -> Checked:
    """Return a check that found what is allowed, and worth a look."""
    return Checked(name=name, outcome=Outcome.SEEN, found=found)


def skipped(name: str, why: str) -> Checked:
    """Return a check that was not made."""
    return Checked(name=name, outcome=Outcome.SKIPPED, found=why)
