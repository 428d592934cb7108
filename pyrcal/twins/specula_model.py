"""Write a fitted bench as a SPECULA model: a parameter file, and FITS files as SPECULA saves them.

The layouts are those of SPECULA 1.1.0. Its images are numbered from the one at the upper right to
the left, around; its x runs along the rows, so that its first slopes are Sy of conventions.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.specula import NANOMETRE_M, write_fits
from pyrcal.twins.sampled import Exported, SampledBench, sample_bench
from service.errors import MatrixError, StorageError
from service.files.container import opened
from service.files.disk_cache import cached_basis
from service.instrument import load_instrument
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.pupil import valid_subapertures
from service.model.slopes import slopes_of

Array = NDArray[Any]

NAME = "specula_model.yml"
"""Name of the parameter file; the FITS files are in a folder next to it."""

LOOP = "specula_loop.yml"
"""Name of the changes that make a closed loop of it."""

CALIBRATION = "calibration"
"""Folder of the FITS files, ``root_dir`` of the parameter file."""

TAG = "bench"
"""Name of all FITS files, each in the folder of its kind."""

MAX_OFF_GRID_PX = 0.02
"""Displacement of a pupil image from which on a remark names it, pixels."""

STATIC = "static"
"""Name of the static aberration, and of its FITS file."""

_STATIC = f"""\
{STATIC}_commands:
  class: WaveGenerator
  constant: [1.0]
  outputs: [output]
{STATIC}:
  class: DM
  simul_params_ref: main
  height: 0.0
  ifunc_object: {STATIC}
  sign: 1
  inputs:
    in_command: {STATIC}_commands.output
  outputs: [out_layer]
"""

_STROKE_WAVES = 0.002
"""RMS of the shapes that the calibration pushes, wavelengths."""

_IMAGES = ((0, 1), (0, 0), (1, 0), (1, 1))
"""Side along y and along x of each of SPECULA's images."""


def to_specula(
    instrument: Instrument | str | Path,
    folder: str | Path,
    found: Fit | Misregistration | None = None,
) -> Exported:
    """Write an instrument as a SPECULA model: a parameter file and its calibration FITS files.

    Parameters
    ----------
    instrument
        As ``load_instrument`` returns it, or what that takes.
    folder
        Folder to write; files of an earlier model in it are replaced.
    found
        Fit of its matrix, whose optical values the model then has, or a registration; None for
        perfect registration.

    Returns
    -------
    Exported
        ``path`` of the parameter file, and ``remarks`` on what it assumes or cannot say.

    Raises
    ------
    ModelError
        If the sensor is no pyramid.
    StorageError
        If writing fails.
    """
    if not isinstance(instrument, Instrument):
        instrument = load_instrument(instrument)
    if not isinstance(found, Fit):
        found = _compute_fit(instrument, found or Misregistration())
    bench = sample_bench(instrument, found)
    try:
        return write_specula_model(bench, found, Path(folder))
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written: {error}") from error


def _compute_fit(instrument: Instrument, alpha: Misregistration) -> Fit:
    """Return what a fit of the instrument's own matrix at this registration would find."""
    basis, valid = cached_basis(instrument), valid_subapertures(instrument)
    matrix = InteractionModel(instrument, basis).interaction_matrix(alpha)
    n_modes, n_planes = basis.n_modes, instrument.slopes.kind.n_planes
    return Fit(
        alpha=alpha,
        covariance=np.zeros((4, 4)),
        subset_scatter=np.zeros(4),
        gains=np.ones(n_modes),
        residual_fraction=0.0,
        residual_map=np.where(valid, 0.0, np.nan) * np.ones((n_planes, 1, 1)),
        residual_by_mode=np.zeros(n_modes),
        condition_number=float(np.linalg.cond(matrix)),
        modes=np.arange(n_modes),
        orientation=instrument.slopes.assumed_orientation,
        order=instrument.slopes.order,
        accepted=True,
        verdict="computed: no matrix was fitted",
        synthetic=matrix,
        measured=matrix,
        valid=valid,
    )


def write_specula_model(bench: SampledBench, fit: Fit, folder: Path) -> Exported:
    """Write the model into ``folder``: the fitted modes, and slopes in the axes of conventions.md.

    ``specula --cpu specula_model.yml``, run in the folder, measures the interaction matrix; with
    ``specula_loop.yml`` as a second file it closes the loop on a static aberration.
    """
    bench = _move_pupil(bench)
    apart, width = _place_images(bench)
    lit = bench.amplitude > 0.0
    functions, modes = bench.render_functions(lit)
    # SPECULA counts nanometres, here of the bench's own unit where its stroke is unknown.
    known = bench.instrument.mirror.stroke_known
    unit_m = NANOMETRE_M if known else bench.unit_m
    m2c = modes[:, fit.modes] * (unit_m / NANOMETRE_M)
    root, pitch_m = folder / CALIBRATION, bench.width_m / bench.n_points
    _save(root, "ifunc", {}, INFLUENCE_FUNCTION=functions, MASK_INF_FUNC=lit.astype(float))
    _save(root, "m2c", {}, M2C=m2c)
    stop = {"OBJ_TYPE": "Pupilstop", "PIXPUPIL": bench.n_points, "PIXPITCH": pitch_m}
    stop |= {"SHIFTX": 0.0, "SHIFTY": 0.0, "ROTATION": 0.0, "MAGNIFIC": 1.0}
    _save(root, "pupilstop", stop, AMPLITUDE=bench.amplitude)
    _save_pupils(root, bench, apart, width)
    if bench.aberration_m is not None:
        static = {"INFLUENCE_FUNCTION": bench.aberration_m[lit][:, None] / NANOMETRE_M}
        _save(root, "ifunc", {}, STATIC, **static, MASK_INF_FUNC=lit.astype(float))
    light = 1.0 if fit.gain_map is None else fit.gain_map[fit.valid][:, None]
    slopes = slopes_of(fit.synthetic, bench.instrument.slopes.kind) * light
    slopes = slopes.reshape(-1, len(fit.modes))
    reconstructor = np.linalg.pinv(swap_slopes(slopes.astype(float)) * unit_m)
    _save(root, "rec", {"NORMFACT": 0.0}, RECMAT=reconstructor)
    wavelength_m, n = bench.instrument.wfs.wavelength_m, bench.n_subapertures
    strokes = _STROKE_WAVES * wavelength_m / NANOMETRE_M / (functions @ m2c).std(axis=0)
    first, second, _ = bench.modulation
    # its tilts rise by the wavelength from the first sample to the last
    radius = math.sqrt(first * second) * (bench.n_points - 1) / bench.n_points
    values = {
        "name": bench.instrument.name,
        "file": NAME,
        "loop": LOOP,
        "root": CALIBRATION,
        "tag": TAG,
        "unit": "nanometres of OPD" if known else "units of the bench",
        "n_points": bench.n_points,
        "pitch_m": pitch_m,
        "n_modes": len(strokes),
        "total_time_s": 2 * len(strokes) / 1000,
        "strokes": [float(f"{one:.6g}") for one in strokes],
        "wavelength_nm": wavelength_m / NANOMETRE_M,
        "fov_arcsec": math.degrees(wavelength_m / pitch_m) * 3600.0,
        "n_subapertures": n,
        "separation": apart,
        "width": width,
        "fft_res": width / n,
        "modulation": radius,
        "static": "" if bench.aberration_m is None else _STATIC,
        "static_layer": "" if bench.aberration_m is None else f"{STATIC}.out_layer, ",
        "n_modulation": max(1, 4 * math.ceil(2 * math.pi * radius / 4)),
    }
    for name, template in ((NAME, "specula_twin.yml"), (LOOP, LOOP)):
        text = Path(__file__).with_name(template).read_text(encoding="utf-8")
        (folder / name).write_text(Template(text).substitute(values), encoding="utf-8")
    return Exported(path=folder / NAME, remarks=(*bench.remarks, *_list_limits(bench)))


def read_matrix(folder: Path) -> Array:
    """Return the interaction matrix ``(n_slopes, n_modes)`` that SPECULA measured, all Sx first.

    Raises
    ------
    MatrixError
        If SPECULA has written none.
    """
    with opened(folder / CALIBRATION / "im" / f"{TAG}.fits") as container:
        found = container.find("INTMAT")
        if found is None:
            raise MatrixError(f"{container.path}: found no INTMAT, expected SPECULA's matrix")
        return swap_slopes(found.numbers())


def swap_slopes(matrix: Array) -> Array:
    """Return SPECULA's slopes ``(n_slopes, ...)`` as all Sx, then all Sy, or the reverse."""
    return np.concatenate([matrix[len(matrix) // 2 :], matrix[: len(matrix) // 2]])


def _move_pupil(bench: SampledBench) -> SampledBench:
    """Return the bench with the pupil itself off the middle, where its four images were.

    SPECULA's images are as far off its grid of pixels as the pupil is off the middle of its array.
    """
    moved, sampling = bench.pupil_shift_subap, bench.points_per_pixel * bench.pixels
    if not np.any(moved):
        return bench
    margin = math.ceil(np.abs(moved).max())

    def move(drawn: Array) -> Array:
        wider = np.pad(drawn, margin * sampling)
        return np.asarray(scipy.ndimage.shift(wider, moved[::-1] * sampling, order=1))

    return replace(
        bench,
        n_pixels=bench.n_pixels + 2 * margin * bench.pixels,
        amplitude=move(bench.amplitude),
        aberration_m=None if bench.aberration_m is None else move(bench.aberration_m),
        pupil_shift_subap=np.zeros(2),
        image_places_px=bench.image_places_px - moved * bench.pixels,
        valid=np.pad(bench.valid, margin),
    )


def _place_images(bench: SampledBench) -> tuple[int, int]:
    """Return the separation of the images and the width of the detector, subapertures.

    Both in whole subapertures on both sides of the middle, as SPECULA cuts images.
    """
    n = bench.n_subapertures
    apart = n + 2 * round((bench.separation_px / bench.pixels - n) / 2)
    return apart, max(apart + n, 2 * round(bench.width_px / bench.pixels / 2))


def _save_pupils(root: Path, bench: SampledBench, apart: int, width: int) -> None:
    """Write the pixels of the valid subapertures in the four images as SPECULA's ``PupData``."""
    row, column = np.nonzero(bench.valid)
    corner = (width - bench.n_subapertures - apart) // 2
    side_y, side_x = np.transpose(_IMAGES)
    rows = row[:, None] + corner + side_y * apart
    columns = column[:, None] + corner + side_x * apart
    arrays = {
        "PIXELS": rows * width + columns,
        "RADIUS": (np.ptp(rows, axis=0) + 1) / 2.0,
        "CX": (columns.min(axis=0) + columns.max(axis=0)) / 2.0,
        "CY": (rows.min(axis=0) + rows.max(axis=0)) / 2.0,
    }
    _save(root, "pupils", {"VERSION": 2, "FSIZEX": width, "FSIZEY": width}, **arrays)


def _save(root: Path, kind: str, header: dict[str, Any], tag: str = TAG, **arrays: Array) -> None:
    """Write arrays to a file in the folder of their kind."""
    folder = root / kind
    folder.mkdir(parents=True, exist_ok=True)
    write_fits(folder / f"{tag}.fits", header, **arrays)


def _list_limits(bench: SampledBench) -> tuple[str, ...]:
    """Return what SPECULA's parameter file cannot say."""
    found = ["SPECULA's model has slopes of the four pupil images, in the axes of conventions.md."]
    first, second, _ = bench.modulation
    if not math.isclose(first, second, rel_tol=1e-3):
        found.append(
            f"SPECULA's parameter file has no elliptic modulation: semi-axes {first:.3g} and "
            f"{second:.3g} lambda/D are written as a circle of the same area."
        )
    rooftop = abs(bench.rooftop_lambda_over_d)
    if rooftop:
        found.append(
            f"SPECULA's parameter file has no rooftop: that of {rooftop:.2g} lambda/D is left out."
        )
    places = bench.image_places_px
    off = float(np.abs(places - places.mean(axis=(0, 1))).max())
    if off > MAX_OFF_GRID_PX:
        found.append(
            "SPECULA's parameter file has no pupil images off the grid: displacements up to "
            f"{off:.2g} detector pixels are left out."
        )
    apart, width = _place_images(bench)
    if width < 1.1 * (apart + bench.n_subapertures):
        found.append(
            f"SPECULA widens the grid of {width} subapertures to 1.1 times the images, so that "
            "its sampling differs."
        )
    return tuple(found)
