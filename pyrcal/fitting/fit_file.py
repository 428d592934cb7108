"""Fit a matrix in memory or in a file, for the library, the command line and REST."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.alternatives import LIGHT_KEY
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import FitOptions, find_image_places, fit_matrix
from pyrcal.fitting.memory import bytes_of_fit, check_fit
from pyrcal.fitting.origins import FoundStroke
from pyrcal.fitting.recorded import FLUX_FRAME, Recorded, read_recorded
from pyrcal.fitting.report import FitReport
from service.errors import MatrixError
from service.estimation.reference import Reference
from service.files.disk_cache import cached_basis
from service.instrument import load_instrument
from service.model.instrument import Instrument, instrument_sha256
from service.model.kinds import Method, SlopeOrder
from service.model.memory import GB
from service.model.modes import Basis
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import CannotTell, Mapper

Progress = Callable[[str], None]

_SAME_LIGHT = 0.1
"""Modulation, λ/D, that changes the light in the pupil images by less than a per cent or two."""

_EXACT = 0.01
"""RMS share of the signal below which the places of the images are right."""

_PLACED_RESIDUAL = 1.02
"""Residual with the images where their pixels show them over that with fitted places, at most."""

MIN_LIGHT_EXPLAINED = 0.03
"""RMS share of the signal that uneven light must explain for a note that the file has the light."""


def fit(
    instrument: Instrument | str | Path,
    matrix: ArrayLike,
    *,
    modes: ArrayLike | None = None,
    noise: ArrayLike | None = None,
    flux_frame: ArrayLike | None = None,
    double_pass: bool | None = None,
    options: FitOptions | None = None,
    threads: int = 2,
) -> Fit:
    """Return the registration of a measured interaction matrix.

    Parameters
    ----------
    instrument
        As ``load_instrument`` returns it, or what that takes: a packaged name, or a TOML file.
    matrix
        ``(n_slopes, n_modes)`` slope per unit command, slopes in the RTC's order; or detector
        frames ``(n_modes, ny, nx)`` where the instrument has ``wfs.input = "frames"``.
    modes
        ``(n_modes,)`` basis index of each column; None if column k is mode k.
    noise
        ``(n_modes,)`` 1 σ of one slope in each column; None if it is unknown.
    flux_frame
        ``(ny, nx)`` mean detector frame in the counts of the frames; needed for frames.
    double_pass
        Whether light met the mirror twice; None if it is as the instrument says.
    options
        Options of the fit; None for the usual ones. Alternatives are always tried.
    threads
        Threads that share the work.

    Raises
    ------
    MatrixError
        If the matrix cannot be used.
    ModelError
        If the optical model cannot work with the instrument or the options.

    Examples
    --------
    >>> found = pyrcal.fit("flao-lbt", matrix)  # doctest: +SKIP
    >>> found.alpha.rotation_deg, found.accepted  # doctest: +SKIP
    """
    if not isinstance(instrument, Instrument):
        instrument = load_instrument(instrument)
    values = _numbers(matrix, "matrix", (2, 3))
    n_modes = values.shape[1 if values.ndim == 2 else 0]
    indices = None if modes is None else _numbers(modes, "modes", (1,))
    if indices is not None and (
        len(indices) != n_modes or np.any(indices < 0) or np.any(indices != np.round(indices))
    ):
        raise MatrixError(
            f"modes: found {len(indices)} numbers, expected the basis index of each of {n_modes} "
            "columns"
        )
    recorded = Recorded(
        values=values,
        modes=None if indices is None else indices.astype(np.intp),
        noise=None if noise is None else _numbers(noise, "noise", (1,)),
        double_pass=double_pass,
        flux_frame=None if flux_frame is None else _numbers(flux_frame, "flux_frame", (2,)),
        where="matrix",
        sha256="",
    )
    reference, notes = make_reference(recorded, instrument)
    if reference.noise is not None and len(reference.noise) != n_modes:
        raise MatrixError(
            f"noise: found {len(reference.noise)} numbers, expected one for each of {n_modes} modes"
        )
    found = _fit_recorded(instrument, recorded, reference, options or FitOptions(), threads=threads)
    return replace(found, remarks=(*notes, *found.remarks))


def _numbers(given: ArrayLike, name: str, n_axes: tuple[int, ...]) -> NDArray[np.float64]:
    """Return an argument as numbers.

    Raises
    ------
    MatrixError
        If it holds none, or has other axes.
    """
    values = np.asarray(given)
    if values.dtype.kind not in "iuf" or values.ndim not in n_axes or not values.size:
        raise MatrixError(
            f"{name}: found {values.dtype} of shape {values.shape}, expected real numbers with "
            f"{' or '.join(map(str, n_axes))} axes"
        )
    return values.astype(np.float64)


def fit_file(
    instrument: Instrument,
    path: str | Path,
    options: FitOptions,
    *,
    dataset: str | None = None,
    threads: int = 2,
    memory_gb: float | None = None,
    basis: Basis | None = None,
    progress: Progress | None = None,
) -> FitReport:
    """Return the fit of the measured matrix in a file.

    ``basis`` are the instrument's modes; None to use the disk cache or to compute them. A fit that
    would take more than ``memory_gb`` is rejected before it starts; None for no limit.

    Raises
    ------
    MatrixError
        If the file or the matrix cannot be used.
    ModelError
        If the optical model cannot work with the instrument or the options.
    """
    recorded = read_recorded(Path(path), dataset)
    reference, notes = make_reference(recorded, instrument)
    if memory_gb is not None:
        n_modes = len(reference.columns if options.modes is None else options.modes)
        check_fit(instrument, n_modes, memory_gb, gain_map=options.gain_map)
        if bytes_of_fit(instrument, n_modes, gain_map=True) > memory_gb * GB:
            options = replace(options, find_light=False)
    begun = time.perf_counter()
    found = _fit_recorded(
        instrument, recorded, reference, options, threads=threads, basis=basis, progress=progress
    )
    return FitReport(
        fit=found,
        method=options.method,
        instrument=instrument.name,
        instrument_sha256=instrument_sha256(instrument),
        reference=recorded.where,
        reference_sha256=recorded.sha256,
        double_pass=reference.double_pass,
        seconds=time.perf_counter() - begun,
        notes=(*notes, *found.remarks),
    )


def _fit_recorded(
    instrument: Instrument,
    recorded: Recorded,
    reference: Reference,
    options: FitOptions,
    *,
    threads: int,
    basis: Basis | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Return the fit with its alternatives, with the work distributed over threads."""
    report_stage = progress or (lambda _: None)
    options = replace(options, explain=True)
    # BLAS keeps to one thread: nested threading made a fit seven times slower
    with threadpool_limits(1), ThreadPoolExecutor(threads) as pool:
        mapper: Mapper = pool.map if threads > 1 else map
        try:
            if basis is None:
                report_stage("modes")
                basis = cached_basis(instrument)
            found = fit_matrix(
                instrument, reference, options, basis=basis, mapper=mapper, progress=report_stage
            )
            instrument, found = _place_images(
                instrument, recorded, reference, found, options, basis, mapper
            )
            lit = _with_found_light(instrument, recorded, found)
            if lit is not None:
                report_stage("fit")
                again, _ = make_reference(recorded, lit)
                places = found.image_offsets_px
                found = fit_matrix(lit, again, options, basis=basis, mapper=mapper)
                if found.image_offsets_px is None:
                    found = replace(found, image_offsets_px=places)
        except MatrixError as error:
            text = str(error).removeprefix("reference: ")
            raise MatrixError(f"{recorded.where}: {text}") from error
    if recorded.flux_frame is None:
        return found
    if not _has_counts(recorded.flux_frame):
        condition = "there is no mean frame in counts, so that the sensor's gain is unknown"
        unknown = FoundStroke(metres_per_unit=None, sigma=None, condition=condition)
        return replace(found, stroke=unknown)
    no_map = isinstance(kind_of(instrument).light(instrument), CannotTell)
    if options.illumination is not None or no_map:
        return found
    return replace(found, remarks=(*found.remarks, *_note_flux_frame(found)))


def _place_images(
    instrument: Instrument,
    recorded: Recorded,
    reference: Reference,
    found: Fit,
    options: FitOptions,
    basis: Basis,
    mapper: Mapper,
) -> tuple[Instrument, Fit]:
    """Return instrument and fit with the images where whole frames of a simulation show them.

    Slopes hardly change when images are stretched apart, but their pixels do. Frames of a real
    bench are left to the fit of slopes: uneven light would displace the images.
    """
    kind, key = kind_of(instrument), kind_of(instrument).find_fitted_key(instrument.wfs)
    simulated = instrument.frames is not None and kind.fine_sampling_of(instrument.wfs) is not None
    fitted = found.image_offsets_px is not None and options.method is Method.JOINT
    if not simulated or not fitted or found.residual_fraction < _EXACT:
        return instrument, found
    number = next((one.found for one in found.optics if one.key == key), None)
    known = {} if number is None else {str(key): number}
    images = replace(
        instrument,
        wfs=replace(instrument.wfs, **known),
        slopes=replace(instrument.slopes, order=SlopeOrder.IMAGES),
    )
    signals, _ = make_reference(recorded, images)
    begin = replace(options, start=found.alpha)
    places = find_image_places(images, signals, begin, basis, mapper)
    if places is None:
        return instrument, found
    placed = replace(instrument, wfs=kind.with_images_at(instrument, places))
    again = fit_matrix(placed, reference, options, basis=basis, mapper=mapper)
    # With places of its own, a fit leaves a little less noise.
    if again.residual_fraction > _PLACED_RESIDUAL * found.residual_fraction:
        return instrument, found
    return placed, replace(again, image_offsets_px=places)


def _has_counts(light: NDArray[np.float64]) -> bool:
    """Return False for a mask of 0 and 1 or 255, and for light divided by its brightest pixel."""
    brightest = light.max()
    return bool(brightest != 1.0 and not np.isin(light, (0.0, 255.0)).all())


def _with_found_light(instrument: Instrument, recorded: Recorded, found: Fit) -> Instrument | None:
    """Return the instrument whose light normalises frames without a mean frame as it should.

    That light is the model's, and depends on the modulation: with none as little as half of it is
    in the pupil images. None if slopes are normalised by measured light, or rightly.
    """
    key = kind_of(instrument).find_fitted_key(instrument.wfs)
    if recorded.values.ndim == 2 or recorded.flux_frame is not None:
        return None
    if f"wfs.{key}" not in instrument.unknown:
        return None
    number = next((one.found for one in found.optics if one.key == key), None)
    if number is None or abs(number - getattr(instrument.wfs, str(key))) < _SAME_LIGHT:
        return None
    return replace(instrument, wfs=replace(instrument.wfs, **{str(key): number}))


def _note_flux_frame(found: Fit) -> Iterator[str]:
    """Yield that the light in the file of the matrix would lower σ, if it would."""
    cut = (
        f"the light is in the same file: cut the four pupil images out of {FLUX_FRAME}, "
        "save their counts as flux (4, n, n) and give them (--flux-map)"
    )
    if found.gain_map is not None:
        yield f"a gain over the pupil is fitted in place of the light; {cut}"
    for one in found.alternatives:
        gained = 1.0 - (1.0 if one.share is None else min(one.share, 1.0))
        explained = found.residual_fraction * float(np.sqrt(gained))
        if one.key == LIGHT_KEY and explained > MIN_LIGHT_EXPLAINED:
            words = f"uneven light explains {explained:.0%} of the signal"
            yield f"{words}, and sigma allows for it; {cut}"


def make_reference(recorded: Recorded, instrument: Instrument) -> tuple[Reference, tuple[str, ...]]:
    """Return the matrix to be fitted, and the decisions made on the way.

    Raises
    ------
    MatrixError
        If the file holds frames and the instrument slopes, or the other way round.
    """
    notes = [*instrument.remarks, *filter(None, [recorded.remark])]
    double_pass = instrument.double_pass
    # The measured file describes the measurement itself, so it takes precedence.
    if recorded.double_pass is not None and recorded.double_pass is not double_pass:
        double_pass = recorded.double_pass
        notes.append(
            f"double pass: {'yes' if double_pass else 'no'}, as the measured file says; the "
            "instrument file says otherwise"
        )
    if recorded.modes is not None:
        notes.append(f"columns belong to the {len(recorded.modes)} modes the measured file names")
    frames = recorded.values.ndim == 3
    if frames and recorded.noise is not None:
        notes.append("the noise in the measured file is of frames, not of slopes: not used")
    matrix, found, place_sigma = _slopes(recorded, instrument)
    notes += found
    reference = Reference(
        matrix=matrix,
        modes=recorded.modes,
        noise=None if frames else recorded.noise,
        double_pass=double_pass,
        place_sigma_subap=place_sigma,
    )
    return reference, tuple(notes)


def _slopes(
    recorded: Recorded, instrument: Instrument
) -> tuple[NDArray[np.float64], tuple[str, ...], float]:
    """Return the measured slopes, made of detector frames if necessary, notes, and σ.

    The last value is 1 σ of the place of the grid on the pupil images, subapertures.
    """
    found = f"{recorded.where}: found shape {recorded.values.shape}"
    if instrument.frames is None:
        if recorded.values.ndim == 3:
            raise MatrixError(
                f"{found}, expected (n_slopes, n_modes): detector frames need "
                'wfs.input = "frames" in the instrument file'
            )
        return recorded.values, (), 0.0
    if recorded.values.ndim != 3:
        raise MatrixError(
            f'{found}, expected detector frames (n_modes, ny, nx): wfs.input is "frames"'
        )
    kind, flux_frame = kind_of(instrument), recorded.flux_frame
    if flux_frame is None:
        if not kind.knows_mean_light(instrument):
            raise MatrixError(
                f"{recorded.where}: found no {FLUX_FRAME} next to it, expected a mean detector "
                "frame (ny, nx) in the same counts"
            )
        return kind.signals_of_frames(instrument, recorded.values, None), (), 0.0
    located, remarks, sigma = kind.locate_images(instrument, flux_frame)
    return kind.signals_of_frames(located, recorded.values, flux_frame), remarks, sigma
