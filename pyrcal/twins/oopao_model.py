"""Write a fitted bench as an OOPAO model: one Python file, and its arrays."""

from __future__ import annotations

import math
import re
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pyrcal.fitting.fitted import Fit
from pyrcal.importers.oopao import to_oopao
from pyrcal.twins.exported import Exported
from pyrcal.twins.sampled import SampledBench, sample_bench
from service.model.instrument import Instrument
from service.model.kinds import SignalKind
from service.model.modes import ModalBasis
from service.model.pupil import instrument_pupil
from service.model.surface import Gaussian

NAME = "oopao_model.py"
"""Name of the Python file; its arrays have the same name and end in ``.npz``."""

_FACES = ([1, 1, 0, 0], [1, 0, 0, 1])
"""Side along y and along x of the pupil image that each of OOPAO's four faces lights."""


def write_oopao_model(
    instrument: Instrument,
    fit: Fit,
    folder: Path,
    *,
    frame_shape: tuple[int, int] | None = None,
    sky: Instrument | None = None,
) -> Exported:
    """Write the model into ``folder``.

    Parameters
    ----------
    instrument, fit
        The bench and the fit of its matrix.
    folder
        Existing folder; files of an earlier model in it are replaced.
    frame_shape
        Rows and columns of the bench's frames; None if it has slopes.
    sky
        The same instrument with the pupil on the sky; None if it is that of the calibration.

    Raises
    ------
    ModelError
        If the sensor is no pyramid.
    """
    bench = sample_bench(instrument, fit, frame_shape)
    mirror, arrays = _describe_mirror(bench)
    index, sign = bench.list_signals(frame_shape)
    whole = instrument.frames is not None or instrument.slopes.kind is SignalKind.INTENSITY
    valid = np.ones((bench.width_px, bench.width_px), bool) if whole else bench.valid
    arrays |= {"amplitude": bench.amplitude, "valid": valid}
    arrays |= {"signal_index": index, "signal_sign": sign}
    if sky is not None:
        lit = instrument_pupil(sky, bench.points_per_pixel * bench.pixels).amplitude
        arrays["sky_amplitude"] = np.pad(lit, (bench.n_points - len(lit)) // 2)
    shape = (frame_shape or valid.shape) if instrument.frames is not None else index.shape
    values = {
        "BENCH": instrument.name,
        **_describe_sensor(bench),
        "POST_PROCESSING": "fullFrame_sum_flux" if whole else "slopesMaps",
        **mirror,
        "SHAPE": tuple(map(int, shape)),
    }
    path = folder / NAME
    path.write_text(_fill_in(values), encoding="utf-8")
    np.savez_compressed(path.with_suffix(".npz"), **arrays)
    return Exported(path=path, remarks=bench.remarks)


def _fill_in(values: dict[str, Any]) -> str:
    """Return the text of the model with its constants."""
    text = Path(__file__).with_name("oopao_twin.py").read_text(encoding="utf-8")
    for name, value in values.items():
        # a function, because backslashes of a text would be read as references to groups
        insert = partial(_assign, value=value)
        text = re.sub(rf"^({name}(?:: [^=]+)?) = .*$", insert, text, flags=re.MULTILINE)
    return text


def _assign(line: re.Match[str], value: object) -> str:
    return f"{line[1]} = {value!r}"


def _describe_sensor(bench: SampledBench) -> dict[str, Any]:
    """Return the constants of telescope and pyramid."""
    # the first and the last of OOPAO's points are one diameter apart
    steps = (bench.n_points - 1) / bench.n_points
    first, second, angle = bench.modulation
    apart = bench.separation_px - bench.n_pixels
    columns, rows = np.moveaxis(bench.image_places_px, -1, 0)
    circle = math.isclose(first, second, rel_tol=1e-6)
    return {
        "RESOLUTION": bench.n_points,
        "WIDTH_M": float(bench.width_m),
        "WAVELENGTH_M": float(bench.instrument.wfs.wavelength_m),
        "N_PIXELS": bench.n_pixels,
        "N_PIX_SEPARATION": _short(apart),
        "N_PIX_EDGE": _short((bench.width_px - 2 * bench.n_pixels - apart) / 2),
        "MODULATION": float(max(first, second) * steps),
        "ELLIPSE": None
        if circle
        else (float(first * steps), float(second * steps), math.degrees(angle)),
        "SHIFT_X": [round(float(one), 5) for one in columns[_FACES]],
        "SHIFT_Y": [round(-float(one), 5) for one in rows[_FACES]],
    }


def _short(number: float) -> float | int:
    """Return a whole number as OOPAO prints it."""
    return int(number) if float(number).is_integer() else float(number)


def _describe_mirror(bench: SampledBench) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the constants of the mirror, and its arrays."""
    # A wavefront that rises moves OOPAO's light to the other side than that of conventions.md.
    sign, basis = 1 if bench.reverse else -1, bench.basis
    surface = basis.surface if isinstance(basis, ModalBasis) else None
    if (
        not isinstance(surface, Gaussian)
        or surface.segments_deg
        or not isinstance(basis, ModalBasis)
    ):
        functions = bench.render_modes()
        modes = np.eye(functions.shape[1]) * bench.unit_m
        return {"SIGN": sign}, {"functions": functions, "mode_to_actuator": modes}
    steps = (bench.n_points - 1) / bench.n_points
    scale = bench.instrument.subaperture_m / steps
    array = SimpleNamespace(D=bench.width_m, resolution=bench.n_points)
    sensor = SimpleNamespace(nSubap=bench.n_pixels, binning=bench.pixels)
    constants = {
        "SIGN": sign,
        "COUPLING": float(surface.coupling),
        "PITCH_M": float(surface.pitch * scale),
        "MISREGISTRATION": to_oopao(bench.mirror_alpha, array, sensor),
    }
    return constants, {
        "coordinates": surface.positions * [1.0, basis.y_sign] * scale,
        "mode_to_actuator": basis.mode_to_actuator * bench.unit_m,
    }
