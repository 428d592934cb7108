"""One night with the passive estimate: what is read of it, and what the filter makes of that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.night import loop_of
from pyrcal_studies.campaign.plan import Observed
from pyrcal_studies.campaign.small import bench_of
from pyrcal_studies.campaign.telemetry import LINE_FRACTIONS, SETTLING_S, blocks_of
from service.config import load_settings
from service.estimation.kalman import (
    Drift,
    Joint,
    allow_scatter,
    begin_joint,
    corrected,
    forget,
    predicted,
)
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.passive import PASSIVE_MEMORY_S, Passive, accumulate
from service.estimation.windows import WindowRefused
from service.model.misregistration import Misregistration
from service.runtime.policy import policy_of
from service.wire import DitherKind, DitherRequest
from sim_rtc.assembly import Telescope
from sim_rtc.computer.real_time_computer import RealTimeComputer

DITHERED = (409, 427, 445, 463)
AMPLITUDE_M = 5e-9
WINDOW_S = 5.0

BATCHES = 10
"""Of ten frames each, taken at once."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PassiveNight(Observed):
    """What is played; two nights that are equal give the same rows."""

    registered: bool
    seconds: float
    look_s: float
    """Between two looks at the passive estimate."""

    dither_every_s: float
    """0: never."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Look:
    """What is read at one moment, by name of the reading: numeric units."""

    t_s: float
    read: dict[str, Array]
    sigma: dict[str, Array]
    misfit: float


class Watch:
    """The service's three readings of one night: passive, dithered, and both in one filter."""

    def __init__(self, telescope: Telescope, night: PassiveNight) -> None:
        self._telescope, self._night = telescope, night
        self._rate_hz = telescope.settings.frame_rate_hz
        self._passive = Passive(
            n_modes=len(telescope.reconstructor.matrix),
            memory_frames=PASSIVE_MEMORY_S * self._rate_hz,
            delay_frames=telescope.settings.delay_frames,
        )
        policy = policy_of(load_settings(None, {}))
        self._floor = policy.floor
        self._drift = Drift(alpha_rate=policy.drift_rate, bias_memory_s=policy.bias_memory_s)
        self._loop = loop_of(telescope)
        self._lock_in: LockIn | None = None
        self._joint: Joint | None = None
        self._joint_s = 0.0
        self._near = Misregistration()

    def looks(self, computer: RealTimeComputer) -> Iterator[Look]:
        """Yield a look at a time, until the night is over."""
        every = max(round(self._night.dither_every_s * self._rate_hz), 1)
        next_look = round((SETTLING_S + self._night.look_s) * self._rate_hz)
        next_dither = round(SETTLING_S * self._rate_hz) if self._night.dither_every_s else None
        seq = 0
        while seq < self._night.seconds * self._rate_hz:
            if next_dither is not None and seq >= next_dither:
                self._dither(computer)
                next_dither += every
            for block in blocks_of(
                [computer.next_batch() for _ in range(BATCHES)], self._telescope
            ):
                seq = block.first_seq + block.n_frames
                if seq < SETTLING_S * self._rate_hz:
                    continue
                self._passive = accumulate(self._passive, block)
                if self._lock_in is not None:
                    self._lock_in, ended = self._lock_in.accumulate(block)
                    for window in ended:
                        yield from self._window(window, seq / self._rate_hz)
            if seq >= next_look:
                next_look += round(self._night.look_s * self._rate_hz)
                yield from self._look(seq / self._rate_hz)

    def _dither(self, computer: RealTimeComputer) -> None:
        lines = tuple(round(f * self._rate_hz * WINDOW_S) / WINDOW_S for f in LINE_FRACTIONS)
        reply = computer.execute(
            DitherRequest(
                id=f"teach-{self._night.seed}",
                kind=DitherKind.SINE,
                modes=DITHERED,
                amplitude_m=(AMPLITUDE_M,) * len(DITHERED),
                frequency_hz=lines,
                duration_s=WINDOW_S + 2 * SETTLING_S,
            )
        )
        if reply.start_seq is None:
            raise RuntimeError(f"the simulator refused the dither: {reply.reason}")
        plan = LockInPlan(
            modes=DITHERED,
            frequencies_hz=lines,
            amplitude_m=(AMPLITUDE_M,) * len(DITHERED),
            frame_rate_hz=self._rate_hz,
            n_frames=round(WINDOW_S * self._rate_hz),
            first_seq=reply.start_seq + round(SETTLING_S * self._rate_hz),
        )
        self._lock_in = LockIn(plan=plan)

    def _window(self, window: Spectra | WindowRefused, t_s: float) -> Iterator[Look]:
        """Fold a dithered window in."""
        if isinstance(window, WindowRefused):
            return
        found = bench_of("flao-lbt").fit(window, self._loop, self._near)
        if isinstance(found, WindowRefused):
            return
        measured, noise = found.alpha.vector, found.covariance
        prior = self._forward(t_s)
        self._joint = (
            begin_joint(measured, noise) if prior is None else corrected(prior, measured, noise)
        )
        self._near = found.alpha
        yield Look(
            t_s=t_s,
            read={"dithered": measured},
            sigma={"dithered": np.sqrt(np.diag(noise) + self._floor**2)},
            misfit=found.misfit,
        )

    def _look(self, t_s: float) -> Iterator[Look]:
        """Look at the passive estimate, and fold it in when a dither has begun the filter."""
        found = bench_of("flao-lbt").fit_passive(self._passive, self._near)
        if found is None:
            return
        # like the service: no two looks share telemetry
        self._passive = replace(self._passive, sums=(), n_effective=0.0)
        if self._joint is None:
            self._near = found.alpha
        measured, sigma = {"passive": found.alpha.vector}, {"passive": found.sigma}
        prior = self._forward(t_s)
        if prior is not None:
            if not prior.biases:
                prior = forget(prior, found.bias)
            prior = allow_scatter(prior, found.bias, found.bias_excess)
            self._joint = corrected(prior, found.alpha.vector, found.covariance, found.bias)
            measured["followed"] = self._joint.alpha
            own = np.diag(self._joint.alpha_covariance)
            sigma["followed"] = np.sqrt(own + self._floor**2)
        yield Look(t_s=t_s, read=measured, sigma=sigma, misfit=found.misfit)

    def _forward(self, t_s: float) -> Joint | None:
        elapsed_s, self._joint_s = t_s - self._joint_s, t_s
        return None if self._joint is None else predicted(self._joint, self._drift, elapsed_s)
