"""Good files, and forty ways to get them wrong, each with the rule that it breaks."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from pyrcal.conventions import Stream
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.pupil import rtc_valid_subapertures

ALPHA = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=np.deg2rad(1.0), magnification=1.005
)

GOOD_FILE = """
[instrument]
name = "good"
diameter_m = 3.0
obscuration_ratio = 0.1
stop = "telescope"

[wfs]
kind = "pyramid"
n_subapertures = 12
pupil_separation_subap = 16
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0

[mirror]
layout = "grid"
n_across = 13
pitch_m = 0.25
diameter_m = 3.3
influence = "gaussian"
nominal_rotation_deg = 0.0
parity = 1

[modes]
n_modes = 40

[slopes]
order = "xy"
orientation = { swap_xy = false, flip_x = false, flip_y = false, sign = 1 }
"""

DELAY, RATE_HZ, GAIN, N_FRAMES = 2, 1000.0, 0.4, 200


@dataclass(frozen=True)
class Good:
    instrument: object
    matrix: np.ndarray
    valid: np.ndarray
    stream: Stream


@cache
def good(folder):
    path = folder / "good.toml"
    path.write_text(GOOD_FILE, encoding="utf-8")
    instrument = load_instrument(path)
    model = RtcInteractionModel(instrument, modal_basis(instrument))
    matrix = np.asarray(model.interaction_matrix(ALPHA), dtype=np.float64)
    rng = np.random.default_rng(1)
    matrix += 0.01 * matrix.std() * rng.normal(size=matrix.shape)
    return Good(instrument, matrix, rtc_valid_subapertures(instrument), _stream(matrix, rng))


def _stream(matrix, rng):
    """A loop on drifting turbulence: c[k+d] = c[k+d-1] - gain R s[k]."""
    reconstructor = np.linalg.pinv(matrix)
    n_modes = matrix.shape[1]
    sky = np.cumsum(rng.normal(size=(N_FRAMES, n_modes)), axis=0) * 5e-9
    commands = np.zeros((N_FRAMES, n_modes))
    slopes = np.zeros((N_FRAMES, len(matrix)))
    for k in range(N_FRAMES):
        if k >= 1:
            seen = reconstructor @ slopes[k - DELAY] if k >= DELAY else 0.0
            commands[k] = commands[k - 1] - GAIN * seen
        slopes[k] = matrix @ (sky[k] + commands[k])
    t_ns = 1_790_000_000_000_000_000 + np.arange(N_FRAMES, dtype=np.int64) * 1_000_000
    return Stream(
        t_ns_utc=t_ns,
        slopes=slopes,
        commands=commands,
        reconstructor=reconstructor,
        frame_rate_hz=RATE_HZ,
        delay_frames=DELAY,
    )


# --- of a matrix


def _maps(good):
    maps = np.zeros((2, *good.valid.shape, good.matrix.shape[1]))
    maps[:, good.valid] = good.matrix.reshape(2, -1, good.matrix.shape[1])
    return maps


def _listed(maps, good):
    return maps[:, good.valid].reshape(good.matrix.shape)


def by_maps(change):
    return lambda good: _listed(change(_maps(good)), good)


def by_matrix(change):
    return lambda good: change(good.matrix.copy())


def scaled(factor):
    return by_matrix(lambda m: m * factor)


def _halves(m, sx, sy):
    x, y = np.split(m, 2)
    return np.concatenate([sx * x, sy * y])


def _column(m, column, factor):
    m[:, column] *= factor
    return m


def _by_columns(good):
    """The subapertures listed column by column."""
    row, column = np.nonzero(good.valid)
    order = np.lexsort((row, column))
    return np.concatenate([half[order] for half in np.split(good.matrix, 2)])


def _rolled(good):
    return np.concatenate([np.roll(half, 3, axis=0) for half in np.split(good.matrix, 2)])


def _from_below(good):
    return np.concatenate([half[::-1] for half in np.split(good.matrix, 2)])


MATRICES = {
    "transposed": (by_matrix(lambda m: m.T), 13),
    "a slope is missing": (by_matrix(lambda m: m[1:]), 13),
    "a row of zeros before": (by_matrix(lambda m: np.vstack([0 * m[:1], m])), 13),
    "maps, not vectors": (_maps, 13),
    "per nanometre": (scaled(1e-9), 13),
    "per micrometre": (scaled(1e-6), 13),
    "per millimetre": (scaled(1e-3), 13),
    "per kilometre": (scaled(1e3), 13),
    "of both passes": (scaled(2.0), 15),
    "of half a pass": (scaled(0.5), 15),
    "per wave": (scaled(750e-9), 13),
    "per radian of phase": (scaled(750e-9 / (2 * np.pi)), 13),
    "all signs": (scaled(-1.0), 11),
    "sign of Sx": (by_matrix(lambda m: _halves(m, -1, 1)), 11),
    "sign of Sy": (by_matrix(lambda m: _halves(m, 1, -1)), 11),
    "Sy before Sx": (by_matrix(lambda m: np.concatenate(np.split(m, 2)[::-1])), 10),
    "interleaved": (
        by_matrix(lambda m: np.stack(np.split(m, 2), axis=1).reshape(m.shape)),
        10,
    ),
    "column by column": (_by_columns, (1, 10)),
    "rows counted from the top": (by_maps(lambda maps: maps[:, ::-1] * [[[[1]]], [[[-1]]]]), 1),
    "columns counted from the right": (
        by_maps(lambda maps: maps[:, :, ::-1] * [[[[-1]]], [[[1]]]]),
        1,
    ),
    "axes exchanged": (by_maps(lambda maps: maps.transpose(0, 2, 1, 3)[::-1]), 1),
    "half a turn": (by_maps(lambda maps: -maps[:, ::-1, ::-1]), (1, 2)),
    "a quarter of a turn": (
        by_maps(lambda maps: np.rot90(maps, axes=(1, 2))[::-1] * [[[[-1]]], [[[1]]]]),
        (1, 2),
    ),
    "rows mirrored, signs not": (by_maps(lambda maps: maps[:, ::-1]), (1, 11)),
    "subapertures shifted by three": (_rolled, (10, 13)),
    "subapertures from the last": (_from_below, (1, 2, 10, 11)),
    "a column of the other sign": (by_matrix(lambda m: _column(m, 4, -1.0)), 9),
    "a column in another unit": (by_matrix(lambda m: _column(m, 7, 1e3)), 9),
    "a column twice": (by_matrix(lambda m: _column(m, 3, 2.0)), 9),
    "columns exchanged": (by_matrix(lambda m: m[:, [0, 1, 2, 8, 4, 5, 6, 7, 3, *range(9, 40)]]), 9),
    "columns reversed": (by_matrix(lambda m: m[:, ::-1]), (9, 13)),
    "piston first": (
        by_matrix(lambda m: np.column_stack([m[:, -1], m[:, :-1]])),
        (9, 13),
    ),
}


# --- of a stream


def stream_with(**changes):
    return lambda good: replace(
        good.stream,
        **{name: change(getattr(good.stream, name)) for name, change in changes.items()},
    )


STREAMS = {
    "R with the other sign": (stream_with(reconstructor=lambda r: -r), 14),
    "R transposed": (stream_with(reconstructor=lambda r: r.T), 13),
    "commands of the other sign": (stream_with(commands=lambda c: -c), 14),
    "another delay": (stream_with(delay_frames=lambda d: d + 4), 14),
    "commands in nanometres": (
        stream_with(commands=lambda c: c * 1e9, reconstructor=lambda r: r * 1e9),
        8,
    ),
    "frames last": (stream_with(slopes=lambda s: s.T), 13),
    "times in microseconds": (stream_with(t_ns_utc=lambda t: t // 1000), 17),
    "times in seconds": (stream_with(t_ns_utc=lambda t: t * 1e-9), 17),
    "times backwards": (stream_with(t_ns_utc=lambda t: t[::-1]), 17),
    "times that stop": (stream_with(t_ns_utc=lambda t: np.r_[t[:-1], t[-2]]), 17),
    "slopes in milliarcseconds": (
        stream_with(slopes=lambda s: s * 206_265e3, reconstructor=lambda r: r / 206_265e3),
        10,
    ),
    "another rate": (stream_with(frame_rate_hz=lambda f: 2 * f), 17),
}
