"""What a new reconstructor would win, and how many modes may be controlled for now."""

from __future__ import annotations

from dataclasses import dataclass

from service.control.expected_gain import ExpectedGain
from service.model.misregistration import Misregistration


@dataclass(frozen=True, slots=True, kw_only=True)
class Assessment:
    """What the reconstructor in use loses against a new one, at one registration."""

    id: str
    """Of the reconstructor in use then."""

    alpha: Misregistration
    """The registration it was computed for."""

    expected: ExpectedGain
    t_ns_utc: int
    """When it came, by the service's clock."""


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
