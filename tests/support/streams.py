"""What tests of several modules share of unit.runtime.test_streams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.estimation.description import Actuators, Description
from service.estimation.frames import FrameBlock
from service.records.operations import Dither, DitherPurpose
from service.wire import DitherKind, DitherRequest
from tests.support.situations import rtc

N_SLOPES, N_MODES = 6, 8


DESCRIPTION = Description(
    n_slopes=N_SLOPES, n_modes=N_MODES, mode_variance_m2=np.full(N_MODES, 1e-16)
)


RTC = rtc(4, n_modes=N_MODES, n_slopes=N_SLOPES, gains=(0.4,) * 4 + (0.0,) * 4)


WINDOW_S = 0.5


REQUEST = DitherRequest(
    id="dither-1",
    kind=DitherKind.SINE,
    modes=(6,),
    amplitude_m=(5e-9,),
    frequency_hz=(240.0,),
    duration_s=60.0,
)


DITHER = Dither(request=REQUEST, purpose=DitherPurpose.FOLLOW, start_seq=0, asked_ns_utc=0)


def block(first_seq, n=100, *, session="s1", cm_id="initial", dither=True, scale=1e-9, signs=False):
    """Noise with a sine on mode 6, or with random signs on modes 1 and 6."""
    rng = np.random.default_rng(first_seq)
    commands = (scale * rng.standard_normal((n, N_MODES))).astype(np.float32)
    added = np.zeros_like(commands)
    seq = first_seq + np.arange(n)
    if signs:
        added[:, [1, 6]] = 2e-9 * rng.choice([-1.0, 1.0], (n, 2))
    else:
        added[:, 6] = 5e-9 * np.sqrt(2) * np.sin(2 * np.pi * 0.24 * seq)
    return FrameBlock(
        session=session,
        first_seq=first_seq,
        t0_ns_utc=first_seq * 1_000_000,
        dt_ns=1_000_000,
        slopes=rng.standard_normal((n, N_SLOPES)).astype(np.float32),
        commands_m=commands + added,
        dither_m=added if dither else None,
        cm_id=cm_id,
    )


N_MANY = 80


STROKES = np.random.default_rng(4).normal(size=(20, N_MANY))


RING = Actuators(
    positions=np.array(
        [[r * np.cos(t), r * np.sin(t)] for r in (1.0, 2.0) for t in np.arange(10) * 0.628]
    ),
    strokes=STROKES,
)


MANY = rtc(N_MANY, n_modes=N_MANY, n_slopes=N_SLOPES, gains=(0.4,) * N_MANY)


def driven(first_seq, outermost_m):
    """Frames of turbulence of 10 nm per mode, and the last actuator pushed away."""
    rng = np.random.default_rng(first_seq)
    push = np.linalg.lstsq(STROKES[:, 30:], np.eye(20)[19] * outermost_m, rcond=None)[0]
    commands = 1e-8 * rng.standard_normal((10, N_MANY))
    commands[:, 30:] += push
    return replace(
        block(first_seq, 10, dither=False),
        commands_m=commands.astype(np.float32),
        dither_m=None,
    )
