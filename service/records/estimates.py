"""Estimates of α from one window, and windows that gave none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from service.model.misregistration import Determination
from service.records.messages import Message

Array = NDArray[np.float64]


BIAS_FLOOR = np.array([0.10, 0.10, np.deg2rad(0.05), 0.001])
"""1 σ of the bias of a passive estimate that none may go below without a dither, numeric units.

It is the wind's, and the model's own error. Where the loop's own noise hardly shows (a bright star
in 25 m/s) the scatter grows, and the bias with it: a quarter of a subaperture was seen at a scatter
of 0.014. On 12 subapertures a bright star turns it, too: by up to 1 deg at a scatter of 0.4, in
OOPAO's loops. Where 60 modes look through bad seeing the magnification is 2 to 5 times its scatter
too large, every time, and on a bright star the rotation up to 2.5 times off.
"""


BIAS_OVER_SCATTER = np.array([10.0, 10.0, 2.0, 0.0])
"""Multiples of its own scatter that the bias of an estimate may have beyond that."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate(Determination):
    """One estimate of the registration from telemetry.

    The covariance is of the scatter of the data; no model error is in it.
    """

    optical_gain: NDArray[Any]
    """``(n,)`` gain of the sensor on each mode looked at, against the model; complex with a lag."""

    misfit: float
    """Residual power over what noise explains; 1: the model explains the data."""

    step: NDArray[np.float64]
    """``(4,)`` distance from the linearisation to the estimate, numeric units."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassiveEstimate(Estimate):
    """A registration estimated from ordinary telemetry.

    The covariance describes the scatter alone, not the bias. A misfit of NaN means too little
    telemetry.
    """

    @property
    def bias_excess(self) -> NDArray[np.float64]:
        """Return ``(4,)`` variance of the bias beyond its floor, as the scatter indicates it."""
        return np.asarray(np.diag(self.covariance) * np.square(BIAS_OVER_SCATTER))

    @property
    @override
    def sigma(self) -> NDArray[np.float64]:
        """``(4,)`` 1 σ in numeric units where nothing is known of the bias."""
        return np.asarray(
            np.sqrt(np.diag(self.covariance) + np.square(BIAS_FLOOR) + self.bias_excess)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DitheredEstimate(Estimate):
    """One window's estimate, which may enter the registration."""

    lag_frames: NDArray[np.float64]
    """Frames by which slopes lag commands; 0 if the columns are aligned as the contract requires.
    """

    t_ns_utc: int
    """End of the window."""

    cm_id: str | None
    """The reconstructor in use."""

    session: str
    modes: tuple[int, ...] = ()
    """0-based basis index of each gain; empty: not known."""

    gain_sigma: NDArray[np.float64] | None = None
    """``(n,)`` 1 σ of each gain's modulus; None: not known."""

    weak: tuple[int, ...] = ()
    """Modes that were dithered far more weakly than the others: nothing of α depends on them."""

    unexplained: NDArray[np.float64] | None = None
    """``(n,)`` share of the power of each mode's answer that the model does not explain, the noise
    subtracted; None if not measured."""

    answers_as: tuple[int, ...] = ()
    """Mode of the model whose response each mode's answer certainly is, its own where that is not
    certain; empty: not looked at."""

    with_stretches: NDArray[np.float64] | None = None
    """``(6, 6)`` covariance of α and its anamorphosis together; None: that is not followed."""

    stretched: float = 0.0
    """Largest step of an anamorphosis from the linearisation to the estimate."""

    @property
    def strong(self) -> NDArray[np.bool_]:
        """Return ``(n,)`` True for gains of modes that contain information on α."""
        which = np.ones(len(self.optical_gain), dtype=bool)
        which[: len(self.modes)] = [mode not in self.weak for mode in self.modes]
        return which


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LockInEstimate(DitheredEstimate):
    """Registration from one window of sines.

    There is one gain and one lag for each line. Gains are complex, because a lag turns the phase of
    a line. The misfit is the residual power at the lines over that at the side bins.
    """

    dither_m: float = 0.0
    """RMS of all lines together, as applied to the mirror, metres OPD; 0 if it is unknown."""

    window_s: float = 0.0
    """Length of the window, seconds; 0 if it is unknown."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RandomEstimate(DitheredEstimate):
    """Registration from one window of random signs.

    Its lag ``(1,)`` is the share of the response that comes one frame late.
    """

    gain_sigma: NDArray[np.float64]
    """``(n_dithered,)`` 1 σ of each gain."""

    def gains_by_group(self, n_groups: int) -> tuple[tuple[int, ...], Array, Array]:
        """Return modes, gains and 1 σ of at most ``n_groups`` groups of neighbouring modes.

        One mode among hundreds contains little information on its gain, and neighbours have nearly
        equal gains. They are averaged by their noise, and the middle mode represents the group.
        """
        order = np.argsort(self.modes)
        groups = [g for g in np.array_split(order, min(n_groups, len(order))) if len(g)]
        weights = self.gain_sigma**-2.0
        gains = [float(np.average(self.optical_gain[g], weights=weights[g])) for g in groups]
        sigma = [float(weights[g].sum() ** -0.5) for g in groups]
        modes = tuple(self.modes[g[len(g) // 2]] for g in groups)
        return modes, np.array(gains), np.array(sigma)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WideCaptureEstimate:
    """Registration from one window with the loop open."""

    estimate: LockInEstimate
    """Its covariance is the noise's alone."""

    unexplained: float
    """Share of the columns' power, noise taken off, that the model leaves."""

    n_starts: int
    """Starts that were tried."""


class RefusalKind(StrEnum):
    """Kinds of windows that give no estimate, as far as anything follows from it."""

    OTHER = "other"
    """It is counted, and no more."""

    CUT_SHORT = "cut-short"
    """Its reconstructor or its dither ended in it, which they do when all is well."""

    VOID = "void"
    """It was taken while nothing could be measured, for a reason that is known."""

    MISALIGNED = "misaligned"
    """The slopes of a row are not those that its commands were sent for."""

    OUT_OF_REACH = "out-of-reach"
    """The registration is too far from where the fit began."""

    NOT_FOUND = "not-found"
    """It was good, of an open loop, and no registration explains it."""

    MISDESCRIBED = "mistold"
    """It shows that slopes or commands are not what the instrument file says."""


Why = tuple[RefusalKind, Message]
"""Kind of a rejection, and its reason."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowRefused:
    """A window that gave no estimate."""

    reason: str | Message
    """Description of the cause, and what to do about it."""

    t_ns_utc: int
    """Time of the rejection."""

    kind: RefusalKind = RefusalKind.OTHER
