"""The telemetry of a night, as it arrives: dithers asked for, frames cut into windows."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pyrcal_studies.campaign.plan import Estimator, Night
from pyrcal_studies.campaign.trouble import strike, told, troubled
from service.estimation.frames import FrameBlock
from service.estimation.lockin import LockIn, LockInPlan, Spectra
from service.estimation.random_dither import Correlated, RandomDither, RandomPlan
from service.estimation.windows import WindowRefused
from service.wire import DitherKind, DitherRequest
from sim_rtc.assembly import Telescope
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import Batch
from sim_rtc.truth import WavefrontError

LINE_FRACTIONS = (0.211, 0.239, 0.283, 0.331)
"""Of the frame rate: what the service dithers at by itself."""

SETTLING_S = 0.5
BLOCK_BATCHES = 20

Window = Spectra | Correlated | WindowRefused
Plan = LockInPlan | RandomPlan


@dataclass(slots=True, kw_only=True)
class Arriving:
    """Frames of one telescope on their way to an estimator."""

    night: Night
    telescope: Telescope
    computer: RealTimeComputer
    error: WavefrontError
    errors_nm: list[float] = field(default_factory=list)
    """Wavefront error of the batches of the window under way, RMS."""

    def windows(self, plan: Plan) -> Iterator[Window]:
        """Yield the windows of this plan, without end."""
        sums: Any = RandomDither(plan=plan) if isinstance(plan, RandomPlan) else LockIn(plan=plan)
        waited, strikes_at = 0, float(plan.first_seq + plan.n_frames / 2)
        for blocks in self._blocks(plan.first_seq):
            for block in blocks:
                sums, ended = sums.accumulate(block)
                yield from ended
                waited = 0 if ended or sums.window is not None else waited + block.n_frames
            if waited > 2 * plan.n_frames:
                yield WindowRefused(reason="no frame carried a dither", t_ns_utc=0)
                waited = plan.n_frames
            if blocks and blocks[-1].first_seq + blocks[-1].n_frames >= strikes_at:
                strikes_at = np.inf
                if strike(self.night.trouble, self.computer):
                    again = start_dither(self.night, self.computer, self._rate_hz)
                    sums = replace(sums, plan=again)

    def _blocks(self, first_seq: int) -> Iterator[list[FrameBlock]]:
        """Yield what arrives, some batches at a time; their wavefront error is noted."""
        rng = np.random.default_rng(self.night.seed)
        while True:
            batches = [self.computer.next_batch() for _ in range(BLOCK_BATCHES)]
            if batches[0].seq0 >= first_seq:
                self.errors_nm += self.error.rms_nm(batches)
            whole = blocks_of(batches, self.telescope)
            yield list(troubled(whole, self.night.trouble, rng))

    @property
    def _rate_hz(self) -> float:
        return self.telescope.settings.frame_rate_hz


def start_dither(night: Night, computer: RealTimeComputer, rate_hz: float) -> Plan:
    """Close the loop for a moment, ask for the dither, and return how it is to be read."""
    computer.next_batch()
    n_frames = round(night.window_s * rate_hz)
    amplitude_m = (night.amplitude_nm * 1e-9,) * len(night.dithered)
    lines = tuple(round(f * rate_hz * night.window_s) / night.window_s for f in LINE_FRACTIONS)
    sine = night.estimator is Estimator.LOCK_IN
    reply = computer.execute(
        DitherRequest(
            id="campaign",
            kind=DitherKind.SINE if sine else DitherKind.BINARY,
            modes=told(night.trouble, night.dithered),
            amplitude_m=amplitude_m,
            frequency_hz=lines if sine else None,
            duration_s=2.0 + 1.5 * night.window_s * (night.n_windows + 2),
            seed=night.seed,
        )
    )
    if reply.start_seq is None:
        raise RuntimeError(f"the simulator refused the dither: {reply.reason}")
    first_seq = reply.start_seq + round(SETTLING_S * rate_hz)
    if night.estimator is Estimator.RANDOM:
        return RandomPlan(
            modes=night.dithered,
            amplitude_m=amplitude_m,
            n_frames=n_frames,
            first_seq=first_seq,
        )
    return LockInPlan(
        modes=night.dithered,
        frequencies_hz=lines,
        amplitude_m=amplitude_m,
        frame_rate_hz=rate_hz,
        n_frames=n_frames,
        first_seq=first_seq,
    )


def blocks_of(batches: list[Batch], telescope: Telescope) -> list[FrameBlock]:
    """Return batches as the link delivers them: joined while nothing changes."""
    dt_ns = round(1e9 / telescope.settings.frame_rate_hz)
    kept = [(b.session, b.cm_id, b.dither_m is None) for b in batches]
    edges = [0, *(k for k in range(1, len(kept)) if kept[k] != kept[k - 1]), len(kept)]
    blocks = []
    for start, stop in itertools.pairwise(edges):
        part = batches[start:stop]
        dithers = [b.dither_m for b in part if b.dither_m is not None]
        blocks.append(
            FrameBlock(
                session=part[0].session,
                first_seq=part[0].seq0,
                t0_ns_utc=part[0].seq0 * dt_ns,
                dt_ns=dt_ns,
                slopes=np.concatenate([b.slopes for b in part]),
                commands_m=np.concatenate([b.commands_m for b in part]),
                dither_m=np.concatenate(dithers) if dithers else None,
                cm_id=part[0].cm_id,
            )
        )
    return blocks
