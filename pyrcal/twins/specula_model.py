"""Write a fitted bench as a SPECULA model: a parameter file, and FITS files as SPECULA saves them.

The layouts are those of SPECULA 1.1.0. Its images are numbered from the one at the upper right to
the left, around; its x runs along the rows, so that its first slopes are Sy of conventions.md.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.fitted import Fit
from pyrcal.twins.exported import Exported
from pyrcal.twins.sampled import SampledBench, sample_bench
from service.errors import MatrixError
from service.files.container import opened
from service.model.instrument import Instrument
from service.model.kinds import SignalKind
from service.model.modes import ModalBasis
from service.model.slopes import slopes_of
from service.model.surface import Gaussian

Array = NDArray[Any]

NAME = "specula_model.yml"
"""Name of the parameter file; the FITS files are in the folder beside it."""

CALIBRATION = "calibration"
"""Folder of the FITS files, ``root_dir`` of the parameter file."""

TAG = "bench"
"""Name of all FITS files, each in the folder of its kind."""

MAX_OFF_GRID_PX = 0.02
"""Displacement of a pupil image that is worth a remark, pixels."""

_STROKE_WAVES = 0.002
"""RMS of the shapes that the calibration pushes, wavelengths."""

_RAD_TO_ARCSEC = 180.0 / math.pi * 3600.0

_IMAGES = ((0, 1), (0, 0), (1, 0), (1, 1))
"""Side along y and along x of each of SPECULA's images."""


def write_specula_model(
    instrument: Instrument,
    fit: Fit,
    folder: Path,
    *,
    frame_shape: tuple[int, int] | None = None,
) -> Exported:
    """Write the model into ``folder``: the fitted modes, and slopes in the axes of conventions.md.

    ``specula --cpu specula_model.yml``, run in the folder, measures the interaction matrix. The
    arguments are those of ``write_oopao_model``.

    Raises
    ------
    ModelError
        If the sensor is no pyramid.
    """
    bench = sample_bench(instrument, fit, frame_shape)
    apart, width = _place_images(bench)
    functions, m2c = _describe_mirror(bench, fit)
    lit = bench.amplitude > 0.0
    # In a unit of SPECULA, whose commands are nanometres where the bench's stroke is known.
    unit_m = 1e-9 if bench.instrument.mirror.stroke_known else bench.unit_m
    m2c = m2c * (unit_m / 1e-9)
    root = folder / CALIBRATION
    _save_fits(root, "ifunc", {}, INFLUENCE_FUNCTION=functions, MASK_INF_FUNC=lit.astype(float))
    _save_fits(root, "m2c", {}, M2C=m2c)
    stop = {"OBJ_TYPE": "Pupilstop", "PIXPUPIL": bench.n_points, "PIXPITCH": _pitch_m(bench)}
    stop |= {"SHIFTX": 0.0, "SHIFTY": 0.0, "ROTATION": 0.0, "MAGNIFIC": 1.0}
    _save_fits(root, "pupilstop", stop, AMPLITUDE=bench.amplitude)
    _save_pupils(root, _list_pixels(bench, apart, width), width)
    reconstructor = np.linalg.pinv(_sort_slopes(bench, fit.synthetic) * unit_m)
    _save_fits(root, "rec", {"NORMFACT": 0.0}, RECMAT=reconstructor)
    rms_nm = (functions @ m2c).std(axis=0)
    strokes = _STROKE_WAVES * bench.instrument.wfs.wavelength_m * 1e9 / rms_nm
    path = folder / NAME
    path.write_text(_parameters(bench, apart, width, strokes), encoding="utf-8")
    return Exported(path=path, remarks=(*bench.remarks, *_list_limits(bench)))


def _place_images(bench: SampledBench) -> tuple[int, int]:
    """Return the separation of the images and the width of the detector, subapertures.

    Both in whole subapertures on both sides of the middle, as SPECULA cuts images.
    """
    n = bench.n_pixels // bench.pixels
    apart = n + 2 * round((bench.separation_px / bench.pixels - n) / 2)
    return apart, max(apart + n, 2 * round(bench.width_px / bench.pixels / 2))


def _list_pixels(bench: SampledBench, apart: int, width: int) -> Array:
    """Return the pixel of each valid subaperture ``(n_valid, 4)`` in SPECULA's four images."""
    n = bench.n_pixels // bench.pixels
    rows, columns = np.nonzero(bench.valid)
    corner = (width - n - apart) // 2
    return np.column_stack(
        [(rows + corner + y * apart) * width + columns + corner + x * apart for y, x in _IMAGES]
    )


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


def _sort_slopes(bench: SampledBench, matrix: Array) -> Array:
    """Return signals of conventions.md as SPECULA's slopes."""
    kind: SignalKind = bench.instrument.slopes.kind
    both = slopes_of(matrix, kind)
    return swap_slopes(both.reshape(-1, matrix.shape[1]).astype(float))


def _pitch_m(bench: SampledBench) -> float:
    return float(bench.width_m / bench.n_points)


def _describe_mirror(bench: SampledBench, fit: Fit) -> tuple[Array, Array]:
    """Return functions ``(n_lit_points, n_functions)`` where α puts them, and the fitted modes."""
    lit, basis = bench.amplitude.ravel() > 0.0, bench.basis
    if isinstance(basis, ModalBasis) and isinstance(basis.surface, Gaussian):
        points = bench.points_on_mirror()[lit] * [1.0, basis.y_sign]
        return basis.surface.basis(points), basis.mode_to_actuator[:, fit.modes]
    return bench.render_modes()[lit][:, fit.modes], np.eye(len(fit.modes))


def _save_pupils(root: Path, pixels: Array, width: int) -> None:
    """Write the pixels of the four images as SPECULA's ``PupData``."""
    rows, columns = np.divmod(pixels, width)
    centres = [(each.min(axis=0) + each.max(axis=0)) / 2.0 for each in (columns, rows)]
    radius = (np.ptp(rows, axis=0) + 1) / 2.0
    header = {"VERSION": 2, "FSIZEX": width, "FSIZEY": width}
    _save_fits(root, "pupils", header, PIXELS=pixels, RADIUS=radius, CX=centres[0], CY=centres[1])


def _save_fits(root: Path, kind: str, header: dict[str, Any], **arrays: Array) -> None:
    """Write arrays as extensions of a FITS file, in the folder of their kind."""
    from astropy.io import fits

    folder = root / kind
    folder.mkdir(parents=True, exist_ok=True)
    images = [
        fits.ImageHDU(
            np.ascontiguousarray(values, np.int64 if values.dtype.kind in "iu" else np.float32),
            name=name,
        )
        for name, values in arrays.items()
    ]
    first = fits.PrimaryHDU(header=fits.Header({"VERSION": 1, **header}))
    fits.HDUList([first, *images]).writeto(folder / f"{TAG}.fits", overwrite=True)


def _list_limits(bench: SampledBench) -> tuple[str, ...]:
    """Return what SPECULA's parameter file cannot say."""
    found = ["SPECULA's model has slopes of the four pupil images, in the axes of conventions.md."]
    first, second, _ = bench.modulation
    if not math.isclose(first, second, rel_tol=1e-3):
        found.append(
            f"SPECULA's parameter file has no elliptic modulation: semi-axes {first:.3g} and "
            f"{second:.3g} lambda/D are written as a circle of the same area."
        )
    apart, width = _place_images(bench)
    off = float(np.abs(bench.image_places_px - bench.image_places_px.mean(axis=(0, 1))).max())
    if off > MAX_OFF_GRID_PX:
        found.append(
            f"SPECULA's parameter file has no pupil images off the grid: displacements up to "
            f"{off:.2g} detector pixels are left out."
        )
    least = 1.1 * (apart + bench.n_pixels // bench.pixels)
    if width < least:
        found.append(
            f"SPECULA widens the grid of {width} pixels to {least:.0f}, so that its sampling "
            "differs."
        )
    return tuple(found)


def _parameters(bench: SampledBench, apart: int, width: int, strokes: Array) -> str:
    """Return the parameter file: the bench, and a calibration of its interaction matrix."""
    n, wavelength_m = bench.n_pixels // bench.pixels, bench.instrument.wfs.wavelength_m
    pitch_m, n_modes = _pitch_m(bench), len(strokes)
    first, second, _ = bench.modulation
    # its tilts rise by the wavelength from the first sample to the last
    radius = math.sqrt(first * second) * (bench.n_points - 1) / bench.n_points
    steps = max(1, 4 * math.ceil(2 * math.pi * radius / 4))
    return f"""# SPECULA model of {bench.instrument.name}; run: specula --cpu --precision 0 {NAME}
# Commands are {"nanometres" if bench.instrument.mirror.stroke_known else "units of the bench"}.
main:
  class: SimulParams
  root_dir: {CALIBRATION}
  pixel_pupil: {bench.n_points}
  pixel_pitch: {pitch_m!r}
  total_time: {2 * n_modes / 1000!r}
  time_step: 0.001
pupilstop:
  class: Pupilstop
  tag: {TAG}
source:
  class: Source
  polar_coordinates: [0.0, 0.0]
  magnitude: 0.0
  wavelengthInNm: {wavelength_m * 1e9!r}
pushpull:
  class: PushPullGenerator
  nmodes: {n_modes}
  vect_amplitude: {[float(f"{one:.6g}") for one in strokes]}
  outputs: [output]
dm:
  class: DM
  simul_params_ref: main
  height: 0.0
  ifunc_object: {TAG}
  m2c_object: {TAG}
  sign: 1
  inputs: {{in_command: pushpull.output}}
  outputs: [out_layer]
prop:
  class: AtmoPropagation
  simul_params_ref: main
  source_dict_ref: [source]
  inputs: {{common_layer_list: [pupilstop, dm.out_layer]}}
  outputs: [out_source_ef]
pyramid:
  class: ModulatedPyramid
  simul_params_ref: main
  wavelengthInNm: {wavelength_m * 1e9!r}
  fov: {wavelength_m / pitch_m * _RAD_TO_ARCSEC!r}
  pup_diam: {n}
  pup_dist: {apart}
  pup_margin: 0
  output_resolution: {width}
  fft_res: {width / n!r}
  mod_amp: {radius!r}
  mod_step: {steps}
  inputs: {{in_ef: prop.out_source_ef}}
  outputs: [out_i]
detector:
  class: CCD
  simul_params_ref: main
  size: [{width}, {width}]
  dt: 0.001
  bandw: 300.0
  inputs: {{in_i: pyramid.out_i}}
  outputs: [out_pixels]
slopec:
  class: PyrSlopec
  pupdata_object: {TAG}
  inputs: {{in_pixels: detector.out_pixels}}
  outputs: [out_slopes]
im_calibrator:
  class: ImCalibrator
  nmodes: {n_modes}
  im_tag: {TAG}
  overwrite: true
  inputs: {{in_slopes: slopec.out_slopes, in_commands: pushpull.output}}
"""
