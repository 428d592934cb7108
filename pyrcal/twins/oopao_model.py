"""Write a fitted bench as an OOPAO model: one Python file, and its arrays."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.oopao import to_oopao
from pyrcal.twins.sampled import Exported, SampledBench
from service.model.instrument import PupilMap
from service.model.kinds import SignalKind
from service.model.pupil import instrument_pupil

Array = NDArray[Any]

NAME = "oopao_model.py"
"""Name of the Python file; its arrays have the same name and end in ``.npz``."""

_FACES = ([1, 1, 0, 0], [1, 0, 0, 1])
"""Side along y and along x of the pupil image that each of OOPAO's four faces lights."""


def write_oopao_model(
    bench: SampledBench, folder: Path, sky_pupil: Array | None = None
) -> Exported:
    """Write the model of a bench into ``folder``; files of an earlier one are replaced.

    ``sky_pupil`` is the pupil on the sky ``(n, n)``, as wide as its diameter; None if it is that
    of the calibration.
    """
    about = bench.instrument
    constants, arrays = _describe_mirror(bench)
    index, sign = bench.list_signals()
    whole = about.frames is not None or about.slopes.kind is SignalKind.INTENSITY
    valid = np.ones((bench.width_px, bench.width_px), bool) if whole else bench.valid
    arrays |= {"amplitude": bench.amplitude, "valid": valid}
    arrays |= {"signal_index": index, "signal_sign": sign}
    if bench.aberration_m is not None:
        # as of its mirror, see ``_describe_mirror``
        arrays["aberration_m"] = -bench.aberration_m
    if sky_pupil is not None:
        arrays["sky_amplitude"] = _draw_sky(bench, sky_pupil)
    shape = (bench.frame_shape or valid.shape) if about.frames is not None else index.shape
    constants |= {
        "BENCH": about.name,
        **_describe_sensor(bench),
        "POST_PROCESSING": "fullFrame_sum_flux" if whole else "slopesMaps",
        "SHAPE": tuple(map(int, shape)),
    }
    path = folder / NAME
    path.write_text(_fill_in(constants), encoding="utf-8")
    np.savez_compressed(path.with_suffix(".npz"), **arrays)
    return Exported(path=path, remarks=bench.remarks)


def _draw_sky(bench: SampledBench, sky_pupil: Array) -> Array:
    """Return the amplitude of the pupil on the sky, on the array of the calibration's."""
    about = bench.instrument
    lit = PupilMap(lit=sky_pupil.astype(float), pitch_m=about.diameter_m / len(sky_pupil))
    sampling = bench.points_per_pixel * bench.pixels
    drawn = instrument_pupil(replace(about, pupil=lit), sampling).amplitude
    return np.pad(drawn, (bench.n_points - len(drawn)) // 2)


def _fill_in(values: dict[str, Any]) -> str:
    """Return the text of the model with its constants."""
    lines = []
    for source in Path(__file__).with_name("oopao_twin.py").read_text("utf-8").splitlines():
        left, equals, _ = source.partition(" = ")
        key = left.partition(":")[0]
        lines.append(f"{left} = {values[key]!r}" if equals and key in values else source)
    return "\n".join(lines) + "\n"


def _describe_sensor(bench: SampledBench) -> dict[str, Any]:
    """Return the constants of telescope and pyramid."""
    # the first and the last of OOPAO's points are one diameter apart
    steps = (bench.n_points - 1) / bench.n_points
    first, second, angle = bench.modulation
    apart = bench.separation_px - bench.n_pixels
    columns, rows = np.moveaxis(bench.image_places_px, -1, 0)
    across = bench.instrument.wfs.pupil_diameter * bench.pixels * bench.points_per_pixel
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
        # see the importer
        "ROOFTOP": bench.rooftop_lambda_over_d * math.pi * bench.separation_px / across,
        "SHIFT_X": [round(float(one), 5) for one in columns[_FACES]],
        "SHIFT_Y": [round(-float(one), 5) for one in rows[_FACES]],
    }


def _short(number: float) -> float | int:
    """Return a whole number as OOPAO prints it."""
    return int(number) if float(number).is_integer() else float(number)


def _describe_mirror(bench: SampledBench) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the constants of the mirror, and its arrays."""
    # A wavefront that rises moves OOPAO's light to the other side than that of conventions.md.
    sign = 1 if bench.reverse else -1
    if bench.gaussian is None:
        functions, modes = bench.render_functions(np.ones_like(bench.amplitude, bool))
        arrays = {"functions": functions, "mode_to_actuator": modes * bench.unit_m}
        return {"SIGN": sign}, arrays
    basis, surface = bench.gaussian
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
