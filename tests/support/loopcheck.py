"""What tests of several modules share of unit.estimation.test_loopcheck."""

from __future__ import annotations

import numpy as np

from service.estimation.frames import FrameBlock
from service.estimation.windows import ClosedLoop

N_SLOPES, N_MODES, N_CONTROLLED = 60, 24, 16


RATE_HZ = 1000.0


GAIN, LEAK = 0.4, 0.995


RESPONSE = (1e6 * np.random.default_rng(1).standard_normal((N_SLOPES, N_MODES))).astype(np.float32)


INVERSE = np.linalg.pinv(RESPONSE[:, :N_CONTROLLED]).astype(np.float32)


GAINS = np.full(N_CONTROLLED, GAIN, np.float32)


def turbulence(n_frames, rms_m, rng):
    """Smooth random modes: noise through a low-pass of third order, 5 Hz."""
    modes = rng.standard_normal((n_frames, N_MODES))
    for _ in range(3):
        state = np.zeros(N_MODES)
        for row in modes:
            state += 0.03 * (row - state)
            row[:] = state
    return (modes / modes.std(axis=0) * rms_m).astype(np.float32)


def closed_loop(
    *,
    n_frames=2500,
    delay=2,
    matrix=INVERSE,
    gains=GAINS,
    stroke_m=1.0,
    lag_frames=0.0,
    played_m=0.0,
    dither_m=0.0,
    seed=2,
):
    """Return slopes, commands and dither of a modal integrator, mean commands of each exposure.

    ``played_m`` puts the turbulence on the mirror instead of before it; a mirror of first order is
    ``lag_frames`` behind.
    """
    rng = np.random.default_rng(seed)
    sky = turbulence(n_frames, played_m or 2e-7, rng)
    noise = rng.normal(0.0, 0.02, (n_frames, N_SLOPES)).astype(np.float32)
    dither = np.zeros((n_frames, N_MODES), np.float32)
    dither[:, 3] = dither_m * np.sin(2 * np.pi * 0.211 * np.arange(n_frames))
    left = np.exp(-1.0 / lag_frames) if lag_frames else 0.0
    on_average = lag_frames * (1.0 - left)
    decided = np.zeros((n_frames + delay, N_MODES), np.float32)
    slopes, commands = np.empty_like(noise), np.empty_like(sky)
    at = np.zeros(N_MODES, np.float32)
    for k in range(n_frames):
        target = np.clip(decided[k] + dither[k], -stroke_m, stroke_m)
        if played_m:
            target = target + sky[k]
        commands[k] = target + on_average * (at - target)
        at = target + left * (at - target)
        seen = commands[k] if played_m else commands[k] + sky[k]
        slopes[k] = RESPONSE @ seen + noise[k]
        decided[k + delay] = np.float32(LEAK) * decided[k + delay - 1]
        decided[k + delay, : len(gains)] -= gains * (matrix @ slopes[k])
        np.clip(decided[k + delay], -stroke_m, stroke_m, out=decided[k + delay])
    return slopes, commands, dither if dither_m else None


def blocks(telemetry, lengths=(37, 5, 50, 1, 20), *, first=0):
    slopes, commands, dither = telemetry
    start = 0
    while start < len(slopes):
        rows = slice(start, start + lengths[start % len(lengths)])
        yield FrameBlock(
            session="s1",
            first_seq=first + start,
            t0_ns_utc=(first + start) * 1_000_000,
            dt_ns=1_000_000,
            slopes=slopes[rows],
            commands_m=commands[rows],
            dither_m=None if dither is None else dither[rows],
            cm_id="cm-1",
        )
        start = rows.stop


def terms(delay_frames=2.0, gains=GAINS, matrix=INVERSE, rate_hz=RATE_HZ):
    return ClosedLoop(
        cm_id="cm-1",
        reconstructor=matrix,
        gains=gains,
        leak=LEAK,
        delay_frames=delay_frames,
        frame_rate_hz=rate_hz,
    )
