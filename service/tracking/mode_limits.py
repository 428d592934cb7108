"""How many modes may be controlled for now, and which have shown how they answer."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeLimit:
    """More modes than these gate, RTC or operator would not have; they are tried again later."""

    n_modes: int
    """As many as may be controlled for now."""

    since_ns_utc: int
    until_ns_utc: int
    """More are not tried before."""

    wait_s: float
    """From one to the other; doubled each time the limit is found again."""

    reason: str
    """What was said of more: the words of the gate, the RTC or the operator."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeAnswer:
    """How a mode has last answered a dither otherwise than the instrument file says."""

    mode: int
    gain: float
    """Times the model."""

    like: int
    """Mode of the model that it answers as; its own: none certainly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeProof:
    """Which modes have been seen to answer as the instrument file says, apart from any matrix."""

    proven: frozenset[int] = frozenset()
    """Seen in a dithered window: the sign, and the size within a factor of its neighbours'."""

    contrary: frozenset[int] = frozenset()
    """Seen in two windows to answer with another sign or size, or not at all."""

    suspected: frozenset[int] = frozenset()
    """Seen so in one window: the next one decides."""

    strange: frozenset[int] = frozenset()
    """Modes of the RTC's own matrix that could not be recognised in it."""

    answers: tuple[ModeAnswer, ...] = ()
    """Of those contrary or suspected, in order."""

    uneven: frozenset[int] = frozenset()
    """Proven, and in two windows far stronger or weaker than the modes beside them."""

    perhaps_uneven: frozenset[int] = frozenset()
    """Seen so in one window: not proven before the next one."""

    own_uneven: str = ""
    """Which modes are so by the RTC's own matrix; empty: none."""

    shown: frozenset[int] = frozenset()
    """Modes that a dither was asked for to see; empty: what it has shown is known."""

    shown_ns_utc: int = 0
    """When that was."""

    n_tries: int = 0
    """How often in a row that has told nothing of any of them."""

    session: str = ""
    """Session of the RTC in which the service before this one has seen it; empty: this one has."""

    own_response_ratio: float | None = None
    """Median over its modes of the response that the RTC's own matrix tells, over the drawing's;
    None: no matrix has told."""

    @property
    def n_proven(self) -> int:
        """Modes that a dither has shown to answer as they should."""
        return len(self.proven)

    @property
    def contrary_modes(self) -> tuple[int, ...]:
        """Modes that a dither has shown to answer otherwise: none of them is controlled anew."""
        return tuple(sorted(self.contrary))
