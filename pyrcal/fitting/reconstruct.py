"""``pyrcal reconstruct``: compute a reconstructor for a registration."""

from __future__ import annotations

import argparse
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from pyrcal.fitting.fit_table import NOTABLE_DISPLACEMENT_PX, displacement_words
from pyrcal.fitting.instrument_checks import COUPLING_KEY
from pyrcal.fitting.light import read_light
from pyrcal.fitting.memory import check_reconstruction
from pyrcal.fitting.models import set_coupling
from pyrcal.fitting.recorded import file_sha256
from pyrcal.fitting.report import (
    KnownFit,
    Provenance,
    fill_reconstructor,
    orientation_words,
    read_fit,
)
from pyrcal.fitting.specula import write_specula
from pyrcal.terminal import show_progress
from service.control.gains import CalibrationGains
from service.control.reconstructor import InversionMethod, Prior, Recipe, reconstruct
from service.errors import ConfigurationError, MatrixError, say
from service.files import parse_alpha
from service.files.disk_cache import cached_basis
from service.files.whole import write_whole
from service.instrument import load_instrument
from service.model.arrays import arrays_of
from service.model.instrument import Instrument, instrument_sha256
from service.model.interaction import RtcInteractionModel
from service.model.sensors.registry import kind_of

SAMPLING = 4
"""Pupil points per subaperture, and detector nodes: the finest of the design's table that takes
seconds; D is then good to 0.5 %."""


def main(options: argparse.Namespace) -> int:
    """Compute, write, and return the exit status.

    Raises
    ------
    PyrcalError
        If something that was given cannot be used.
    """
    if options.max_condition < 1.0:
        raise ConfigurationError(
            f"--max-condition: found {options.max_condition:g}, expected at least 1"
        )
    arrays, fit = arrays_of(options.array), _read_known_fit(options)
    described = load_instrument(options.instrument)
    found = instrument_sha256(described)
    if fit.instrument_sha256 not in {None, found}:
        say(f"note: {options.instrument} has changed since {fit.origin} was fitted with it")
    instrument = _apply_sensor(_apply_orientation(described, fit), fit)
    check_reconstruction(instrument, options.modes, SAMPLING, options.memory_gb)
    light = None if options.flux_map is None else read_light(options.flux_map, instrument)
    # The pool already has a thread for each core; threads of BLAS would compete with them.
    with threadpool_limits(1), ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        model = RtcInteractionModel(
            instrument,
            set_coupling(cached_basis(instrument), fit.instrument_found.get(COUPLING_KEY)),
            pupil_sampling=SAMPLING,
            detector_nodes=SAMPLING,
            illumination=None if light is None else light.illumination,
            mapper=pool.map,
            arrays=arrays,
        )
        show_progress(f"{model.n_slopes} slopes, {model.basis.n_modes} modes")
        matrix = model.interaction_matrix(fit.alpha)
    provenance, inverted = _invert_matrix(options, fit, model, matrix)
    inversion, slopes = provenance.inversion, instrument.slopes
    fill = partial(
        fill_reconstructor,
        interaction_matrix=inverted[:, : options.modes],
        provenance=provenance,
        circumstances={
            "instrument": instrument.name,
            "instrument_sha256": found,
            "alpha_from": fit.origin,
            **{f"found_{key}": value for key, value in fit.instrument_found.items()},
            "model_pupil_sampling": SAMPLING,
            "model_detector_nodes": SAMPLING,
            "slopes": json.dumps(orientation_words(slopes.assumed_orientation, slopes.order)),
        },
    )
    write_whole(options.output, fill)
    print(
        f"{options.output}: {options.modes} modes, {model.n_slopes} slopes, {options.method}, "
        f"condition number {inversion.condition_number:.2f}, {inversion.n_truncated} singular "
        "values left out"
    )
    if options.specula is not None:
        im, rec = (options.output.with_name(f"{options.output.stem}_{of}.fits") for of in _SPECULA)
        write_specula(
            options.specula,
            im,
            rec,
            inverted[:, : options.modes],
            inversion.matrix,
            stroke_known=instrument.mirror.stroke_known,
        )
        print(f"{im}, {rec}: SPECULA's Intmat and Recmat, commands in nm")
    return 0


_SPECULA = ("im", "rec")
"""Suffixes of the files for SPECULA."""


def _read_known_fit(options: argparse.Namespace) -> KnownFit:
    """Return the registration from the arguments or from a file.

    Raises
    ------
    MatrixError
        If the model does not hold the measured loop with these modes, or the reference is another.
    """
    path = Path(options.alpha)
    if path.is_file():
        fit = read_fit(path)
        _check_control(path, fit, options.modes)
    else:
        fit = KnownFit(alpha=parse_alpha(options.alpha))
    if options.reference is not None:
        found = file_sha256(options.reference)
        if fit.reference_sha256 not in {None, found}:
            raise MatrixError(
                f"{options.reference}: found checksum {found}, expected {fit.reference_sha256} "
                f"of the reference that {path} was fitted to"
            )
        fit = replace(fit, reference_sha256=found)
    return fit


def _check_control(path: Path, fit: KnownFit, n_modes: int) -> None:
    """Raise if the model's reconstructor is unstable with the measured matrix.

    Raises
    ------
    MatrixError
        If the loop of the measured matrix is unstable with so many modes, or nothing is known of
        it and the registration is not determined.
    """
    way_round = "give the registration itself (X,Y,ROT,MAG) to make the reconstructor regardless"
    # Files of earlier versions contain no check of the loop.
    if fit.stable_gain is None:
        if not fit.accepted:
            raise MatrixError(
                f"{path}: the registration was not determined, and the file does not say whether "
                f"its reconstructor is stable; fit again with this version, or {way_round}"
            )
        return
    # The reconstructor's modes are counted in the basis, the stable ones among those fitted.
    fitted = n_modes if fit.modes is None else int((fit.modes < n_modes).sum())
    # The check of the loop decides here, and not the verdict on the registration: a reconstructor
    # may be stable although α is not determined.
    if fit.stable_modes is not None and fitted > fit.stable_modes:
        fewer = (
            f"use --modes {fit.stable_modes}, fit with a lower --gain"
            if fit.stable_modes
            else "fit with a lower --gain, correct the instrument file"
        )
        raise MatrixError(
            f"{path}: a reconstructor of {n_modes} modes makes the loop of the measured matrix "
            f"unstable at gain {fit.stable_gain:g}; it is stable up to {fit.stable_modes} modes; "
            f"{fewer}, or {way_round}"
        )
    if not fit.accepted:
        say(
            f"note: the registration of {path} was not determined; its reconstructor holds the "
            f"loop of the measured matrix at gain {fit.stable_gain:g} all the same"
        )


def _apply_orientation(instrument: Instrument, fit: KnownFit) -> Instrument:
    """Return the instrument with the orientation of the slopes from the fit."""
    recipe = instrument.slopes
    if fit.orientation is not None and fit.order is not None:
        if fit.order.kind is not recipe.kind:
            raise MatrixError(
                f'{fit.origin}: found a fit of slopes.kind = "{fit.order.kind}"; expected '
                f'"{recipe.kind}", as the instrument file says'
            )
        recipe = replace(recipe, orientation=fit.orientation, order=fit.order)
    elif recipe.orientation is None:
        say(
            'note: slopes.orientation is "auto" and no fit has found it: the reconstructor is for '
            "slopes in the axes of docs/howto/fitting.md"
        )
    return replace(instrument, slopes=recipe)


def _apply_sensor(instrument: Instrument, fit: KnownFit) -> Instrument:
    """Return the instrument with the sensor values from the fit; print a note on each."""
    for key, value in fit.instrument_found.items():
        say(f"note: made with {key} = {value:.3g}, as {fit.origin} found; correct the instrument")
    kind = kind_of(instrument)
    if fit.image_offsets_px is not None and kind.image_offsets(instrument) is None:
        # D with images on the pixel grid has an error of 20 % if they are 0.2 pixel off it
        instrument = replace(instrument, wfs=kind.with_images_at(instrument, fit.image_offsets_px))
        if np.abs(fit.image_offsets_px).max() > NOTABLE_DISPLACEMENT_PX:
            words = displacement_words(fit.image_offsets_px)
            say(f"note: made with {words}, as {fit.origin} found")
    sensor_key = kind.find_fitted_key(instrument.wfs)
    if sensor_key is None or sensor_key not in fit.instrument_found:
        return instrument
    number = fit.instrument_found[sensor_key]
    return replace(instrument, wfs=replace(instrument.wfs, **{sensor_key: number}))


def _invert_matrix(
    options: argparse.Namespace, fit: KnownFit, model: RtcInteractionModel, matrix: NDArray[Any]
) -> tuple[Provenance, NDArray[Any]]:
    """Return the reconstructor with its provenance, and the matrix that it inverts."""
    gains = None
    if fit.gains is not None and fit.modes is not None and not options.no_gains:
        gains = CalibrationGains.of_modes(fit.gains, fit.modes, model.basis.n_modes)
        matrix = gains.tuned(matrix)
    recipe = _recipe(options, model)
    provenance = Provenance(
        recipe=recipe,
        inversion=reconstruct(matrix, recipe),
        fit=fit,
        gains=gains,
        measured_illumination=options.flux_map is not None,
    )
    return provenance, matrix


def _recipe(options: argparse.Namespace, model: RtcInteractionModel) -> Recipe:
    prior = None
    if options.method == InversionMethod.MAP:
        prior = Prior(
            variance_m2=model.basis.variance_m2,
            slope_noise=model.slope_noise(options.slope_noise),
        )
    return Recipe(
        n_modes=options.modes,
        max_condition=options.max_condition,
        prior=prior,
    )
