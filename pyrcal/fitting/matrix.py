"""Fit the registration of a measured interaction matrix."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.advice import (
    Advice,
    Grounds,
    add_displaced,
    add_explanations,
    add_recommendation,
)
from pyrcal.fitting.alternatives import LIGHT_KEY, add_alternatives, find_alternatives
from pyrcal.fitting.budget import explain_left_over
from pyrcal.fitting.columns import (
    MAX_SMEAR,
    Smear,
    find_displaced_columns,
    find_noise_columns,
    find_strange_columns,
    measure_smear,
    remove_smear,
)
from pyrcal.fitting.comparison import FitSubset
from pyrcal.fitting.control_check import GAIN, check_control
from pyrcal.fitting.disjoint_sets import SIGNIFICANT
from pyrcal.fitting.fitted import Fit, Registration
from pyrcal.fitting.gain_causes import find_gain_causes
from pyrcal.fitting.instrument_checks import (
    estimate_width_effect,
    fit_file_values,
    list_optics,
    may_compensate,
)
from pyrcal.fitting.methods import (
    OTHER_SENSOR_NUMBERS,
    Landing,
    ScanStep,
    Settled,
    land,
    project_on_sensitivities,
    scan,
    settle,
    settle_at,
)
from pyrcal.fitting.models import FAR_PREFERRED_SHARE, PREFERRED_SHARE, FitModels, Optic
from pyrcal.fitting.noise import bound_noise_share, measure_structure
from pyrcal.fitting.origins import (
    Origin,
    find_families,
    find_stroke,
    list_origins,
    list_undetermined_keys,
)
from pyrcal.fitting.pupil_checks import MIN_PUPIL_EXPLAINED
from pyrcal.fitting.pupil_width import SeenPupil, compute_responses, measure_pupil
from pyrcal.fitting.reference import check_reference
from pyrcal.fitting.remarks import collect_remarks
from pyrcal.fitting.solver import (
    Nuisances,
    Solution,
    image_patterns,
    nuisances_of,
    refine,
)
from pyrcal.fitting.uncertainty import (
    LOCAL_MAGNIFICATION_FLOOR,
    MAGNIFICATION_FLOOR,
    WEAK_MODULATION_FLOOR,
    estimate_uncertainty,
    misplacement_sigma,
    nonlinearity_sigma,
)
from pyrcal.fitting.verdict import FitFindings, judge_fit
from service.errors import ModelError, list_first
from service.estimation.orientation import (
    DOUBTFUL_CORRELATION,
    MIN_CORRELATION,
    MIN_CORRELATION_LEAD,
    LowOrder,
    Search,
    check_stated_orientation,
    coarse_model,
    find_orientation,
    format_setting,
)
from service.estimation.reference import Reference, Target, is_by_actuator, target_of
from service.model.aperture import OFF_CENTRE_SUBAP, check_mask, measure_aperture
from service.model.instrument import Instrument, Mirror
from service.model.kinds import Method, Normalisation, Stop
from service.model.misregistration import Misregistration
from service.model.modes import Basis, modal_basis
from service.model.pupil import Illumination, rtc_valid_subapertures, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Mapper
from service.model.slopes import Orientation, SlopeRecipe

MIN_COLUMNS = 3
"""Smallest number of columns that must remain when columns with noise only are left out."""

_MAX_LISTED = 12

_SMEAR_STEPS = 8
_LONGEST_SMEAR_STEP = 0.15
"""Longest secant step. The registration follows most of a smear of 0.3, so longer secants miss it.
"""
_SMEAR_SETTLED = 1e-3
"""Remaining share of the previous column at which the iteration ends."""

_EDGE_ROUNDS, _EDGES_SETTLED = 8, 0.01
"""Largest number of times that edges are computed, for they depend on the places of the images, and
change of these, subapertures, and of the residual, relative, from which on they are settled.
Unmodulated benches need most."""

_NOTABLE_EDGE_SUBAP = 3e-3
"""1 σ of a shift by turned edges, subapertures, from which on they are computed."""

_EDGE_ERROR = 0.1
"""Share of that σ that is left when they are computed."""

_LEAST_RATE = 0.1
"""Smallest slope of the measured share over the removed share used in the uncertainty."""

MIN_LIGHT_FOUND = 0.1
"""RMS share of the signal that uneven light must explain to be fitted without a request. On
PAPYRUS it explains 0.18, on AO188, whose arms and gains it follows, 0.08. Models of one instrument
differ by 0.01 to 0.07."""

LIGHT_FOUND_WORDS = (
    "the matrix shows uneven light: a smooth gain over the pupil is fitted, and sigma allows for "
    "the registration without it; give the light (--flux-map) if it was measured"
)

_SMEAR_EXPLAINS = 0.9
"""Residual left after the smear is removed over that left before; above this it is rejected."""

Array = NDArray[np.float64]
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitOptions:
    """Options of a fit."""

    method: Method = Method.JOINT
    """Fit method."""

    modes: NDArray[np.intp] | None = None
    """Basis indices to use; None for all that the reference contains."""

    start: Misregistration | None = None
    """Start of the fit. None for a coarse rotation from the lowest orders and nominal other values.
    """

    orientation: Orientation | None = None
    """Orientation of the slopes. None for that of the instrument file, or a search if it has none.
    """

    gain_map: bool = False
    """True to fit a smooth gain over the pupil, common to all modes."""

    find_light: bool = True
    """True to fit that gain also where the matrix clearly prefers it."""

    anamorphosis: bool = True
    """True to fit the anamorphosis of the mirror's image."""

    illumination: Illumination | None = None
    """Measured illumination of the pupil, in the axes of conventions.md; None if it is uniform."""

    explain: bool = False
    """True to search for causes of gains far from 1 and of displaced columns."""

    gain: float = GAIN
    """Integrator gain of the loop in which the reconstructor is checked."""


def fit_matrix(
    instrument: Instrument,
    reference: Reference,
    options: FitOptions | None = None,
    *,
    basis: Basis | None = None,
    mapper: Mapper = map,
    progress: Progress | None = None,
) -> Fit:
    """Return the registration of a measured matrix, with its uncertainty and verdict.

    Parameters
    ----------
    instrument
        Instrument whose matrix was measured.
    reference
        Measured matrix.
    options
        Options of the fit.
    basis
        Modes of the instrument; None to compute them, which takes seconds.
    mapper
        Function like ``map``; an executor's ``map`` distributes the work over threads.
    progress
        Callback for a short text at the beginning of each stage.

    Raises
    ------
    MatrixError
        If the matrix belongs to another instrument, is transposed, in another unit or empty.
    ModelError
        If a requested mode was not measured, or the instrument cannot be modelled.
    """
    options = options or FitOptions()
    report_stage = progress or (lambda _: None)
    try:
        return _fit_usable(instrument, reference, options, basis, mapper, report_stage)
    except np.linalg.LinAlgError as error:
        raise ModelError(
            f"{instrument.name}: found modes that do not depend on the registration ({error}); "
            "expected actuators or tables in metres over the pupil that the sensor sees"
        ) from error


def _fit_usable(
    instrument: Instrument,
    reference: Reference,
    options: FitOptions,
    basis: Basis | None,
    mapper: Mapper,
    report_stage: Progress,
) -> Fit:
    if basis is None:
        report_stage("modes")
        basis = modal_basis(instrument)
    usable = check_reference(
        _remove_shapeless(_select_modes(reference, options.modes), instrument),
        n_slopes=instrument.slopes.kind.n_planes * int(rtc_valid_subapertures(instrument).sum()),
        n_modes=basis.n_modes,
        wavelength_m=instrument.wfs.wavelength_m,
        stroke_known=_stroke_known(instrument),
    )
    used = basis.subset(usable.columns)
    report_stage("orientation")
    # remembered here, because ``_fix_mask`` gives every instrument a mask
    own_mask = instrument.wfs.valid_subapertures is not None
    instrument = _fix_mask(instrument)
    # Kept apart from the recipe that the search finds, so that the report can name what differs.
    reported = replace(
        instrument.slopes, orientation=options.orientation or instrument.slopes.orientation
    )
    instrument, (slopes, pose, axes_doubt, lowest) = _find_axes_and_sensor(
        instrument, usable, used, options, mapper
    )
    instrument = replace(instrument, slopes=slopes)
    target = target_of(usable, instrument)
    models = FitModels(
        instrument=instrument,
        basis=used,
        illumination=options.illumination,
        mapper=mapper,
        lowest=lowest,
    )
    report_stage("fit")
    if options.start is not None:
        start = options.start
    else:
        # The search returns no pose where no rotation explains the lowest orders well enough.
        start = pose if pose is not None else instrument.start
    found = _run_method(models, target, instrument.with_anamorphosis(start), options, report_stage)
    models, found = _fit_shown_pupil(models, found, options, report_stage)
    n_lost = np.count_nonzero(found.settled.solution.projection.gains == 0.0)
    # A gain is exactly 0 where the model's column is 0, or opposite to the measured one.
    if 2 * n_lost > used.n_modes:
        raise ModelError(
            f"{instrument.name}: the fit ended where {n_lost} of {used.n_modes} modes change no "
            "slope; start closer to the true registration (--start), or leave the start out"
        )
    # After a first fit, because noise is distinguished from signal by comparison with a model at α.
    noisy = find_noise_columns(
        found.settled.solution, found.settled.target, instrument.slopes.kind.n_planes
    )
    if noisy.any() and np.sum(~noisy) >= MIN_COLUMNS:
        report_stage("fit")
        usable = _remove_noise(usable, noisy)
        used = basis.subset(usable.columns)
        # The smooth combinations contained the removed modes, so they have to be computed again.
        target, models = target_of(usable, instrument), replace(models, basis=used, lowest=None)
        # From the first result: noise columns moved it little, so the search need not begin again.
        begin = instrument.with_anamorphosis(found.settled.solution.alpha)
        found = _run_method(models, target, begin, options, report_stage)
    # After the fit, because each column is compared with the model of its neighbours at α.
    smear = measure_smear(found.settled.solution, found.settled.target)
    if smear.is_found:
        report_stage("fit")
        found, usable = _remove_smear(
            models, instrument, found, usable, smear, options, report_stage
        )
    found = _turn_edges(found)
    report_stage("verdict")
    found, findings = _gather_with_light(models, found, usable, axes_doubt, options)
    grounds = _gather_grounds(findings, found, axes_doubt, explain=options.explain)
    fit = _make_fit(found, usable, findings, grounds, options)
    fit = _add_notes(fit, found, findings, grounds, models.instrument, reported)
    fit = (add_explanations if options.explain else add_recommendation)(fit, grounds)
    place = models.instrument.pupil_shift_subap
    if place is not None and instrument.pupil_shift_subap is None:
        words = (
            "the mask lacks a part of the pupil's rim: the pupil is taken where the rest shows it, "
            f"{place[0]:+.2f}, {place[1]:+.2f} subapertures off the middle of the grid"
        )
        fit = replace(fit, remarks=(*fit.remarks, words))
    # An accepted fit has its columns in order, and this search repeats that for the orientation.
    if options.explain and not fit.accepted:
        columns = find_displaced_columns(
            replace(instrument, slopes=reported), usable, used, mapper=mapper
        )
        fit = add_displaced(fit, tuple(columns))
    # A mask computed from the pupil agrees with the pupil by construction.
    return _note_mask(fit, instrument) if own_mask else fit


def _fit_shown_pupil(
    models: FitModels, found: _Found, options: FitOptions, report_stage: Progress
) -> tuple[FitModels, _Found]:
    """Return models and fit with the pupil where a mask without a part of its rim shows it.

    Such a mask shows the place to a subaperture at best, so that the matrix decides: with a pupil
    one subaperture off, 45 % of a signal was left over, and 8 % with the pupil in its place.
    """
    about, settled = models.instrument, found.settled
    if about.stop is Stop.MIRROR or settled.share < MIN_PUPIL_EXPLAINED:
        return models, found
    place = measure_aperture(valid_subapertures(about)).centre
    known = about.pupil_shift_subap or kind_of(about).pupil_offset(about)
    if known is not None or np.hypot(*place) < OFF_CENTRE_SUBAP:
        return models, found
    report_stage("fit")
    there = replace(models, instrument=replace(about, pupil_shift_subap=place))
    begin = about.with_anamorphosis(settled.solution.alpha)
    again = _run_method(there, settled.target, begin, options, report_stage)
    left = again.settled.solution.projection.chi / settled.solution.projection.chi
    return (there, again) if left < FAR_PREFERRED_SHARE else (models, found)


def find_image_places(
    instrument: Instrument,
    reference: Reference,
    options: FitOptions,
    basis: Basis,
    mapper: Mapper = map,
) -> Array | None:
    """Return where the pixels of the four images show them, ``(4, 2)`` as the file has them.

    Slopes hardly change when images are stretched apart; the images themselves do. ``reference``
    has the signals of ``instrument``, which are those of the images. None if none were fitted.
    """
    usable = _select_modes(reference, options.modes)
    used = basis.subset(usable.columns)
    about, (slopes, pose, _, lowest) = _find_axes_and_sensor(
        _fix_mask(instrument), usable, used, options, mapper
    )
    about = replace(about, slopes=slopes)
    models = FitModels(instrument=about, basis=used, mapper=mapper, lowest=lowest)
    start = about.with_anamorphosis(options.start or pose or about.start)
    target = target_of(usable, about)
    # Edges that the windows show come first: without them an unmodulated matrix lacks half of it.
    begin = settle_at(models, target, start, _list_nuisances(models, target, options))
    settled = _turn_edges(_Found(settled=begin)).settled
    return _image_offsets(about, settled.nuisances, settled.solution)


def _turn_edges(found: _Found) -> _Found:
    """Return the fit with what the turned edges of a pyramid with displaced images add.

    They change a matrix by 6 % where images are up to three pixels off a square. The model leaves
    them out, so that they are computed at the fit and removed from the measured columns.
    """
    measured, fitted = found.settled.target.matrix, len(found.settled.nuisances.images) > 0
    # A first fit without edges has images elsewhere; their windows are nearer.
    places, n_planes = np.zeros(8), found.settled.models.instrument.slopes.kind.n_planes
    for _ in range(_EDGE_ROUNDS):
        settled = found.settled
        models = settled.models.with_displaced_images(places) if fitted else settled.models
        about, gains = models.instrument, settled.solution.projection.gains
        simulated = kind_of(about).fine_sampling_of(about.wfs) is not None
        expected = kind_of(about).turned_edge_sigma(about, np.zeros((4, 2)))[0]
        # On a real bench more than this is unexplained, and hundreds of modes would take minutes.
        if not simulated or about.stop is Stop.MIRROR or expected < _NOTABLE_EDGE_SUBAP:
            break
        shapes = models.fine.render_modes(settled.solution.alpha)
        edges = kind_of(about).turn_edges(about, models.fine.sensor, shapes)
        cleaned = replace(settled.target, matrix=measured - edges * gains)
        again = settle(settled.models, cleaned, settled.solution.alpha, settled.nuisances)
        if again.share > settled.share and n_planes == 2:
            break  # slopes do not show where the images are
        found = replace(found, settled=again, edges=edges)
        before, places = places, again.nuisances.image_offsets(again.solution.nuisances)
        moved = float(np.abs(places - before).max()) if fitted else 0.0
        if moved < _EDGES_SETTLED and abs(again.share / settled.share - 1.0) < _EDGES_SETTLED:
            break
    return found


def _gather_with_light(
    models: FitModels, found: _Found, usable: Reference, axes: AxesDoubt, options: FitOptions
) -> tuple[_Found, FitFindings]:
    """Return fit and findings, with a smooth gain over the pupil if the matrix shows it."""
    findings = _gather_findings(models, found, usable, axes)
    if not _shows_uneven_light(findings, options):
        return found, findings
    settled, even = found.settled, found.settled.solution
    kind = settled.models.instrument.slopes.kind
    maps = nuisances_of(settled.target.valid, kind, gain_map=True).maps
    nuisances = replace(settled.nuisances, maps=maps)
    # Light hardly moves the other unknowns, so that their derivatives still hold.
    lit = refine(settled.models, settled.target, even.alpha, nuisances, near=even)
    if not lit.converged:
        return found, findings
    again = replace(settled, solution=lit, nuisances=nuisances)
    found = replace(found, settled=again, even=even)
    return found, _gather_findings(models, found, usable, axes)


def _shows_uneven_light(findings: FitFindings, options: FitOptions) -> bool:
    """Return True if uneven light is the only explanation that the matrix clearly prefers.

    A gain over the pupil follows part of what another stop, hole or modulation does, so that it is
    not fitted where one of these is preferred.
    """
    light = next((one for one in findings.alternatives if one.key == LIGHT_KEY), None)
    known = options.gain_map or options.illumination is not None
    usual = options.find_light and options.method is Method.JOINT and not known
    sure = findings.explained and findings.solution.converged and not findings.axes
    if light is None or not usual or not sure:
        return False
    better = light.misfit < PREFERRED_SHARE and light.significance > SIGNIFICANT
    explains = light.explained(findings.residual_fraction) > MIN_LIGHT_FOUND
    return better and explains and not any(one.preferred for one in findings.alternatives)


def _note_mask(fit: Fit, instrument: Instrument) -> Fit:
    """Return the fit with any mismatch between mask and pupil added to remarks and advice."""
    x, y = fit.alpha.vector[:2].tolist()
    difference = check_mask(instrument, (x, y))
    if difference is None:
        return fit
    remarks = fit.remarks
    if difference not in instrument.remarks:
        remarks = (*remarks, difference)
    # where the mirror is the stop, its shift moves the pupil: another stop may be the cause
    of_stop = (
        instrument.stop is Stop.MIRROR
        and check_mask(replace(instrument, stop=Stop.TELESCOPE), (x, y)) is None
    )
    # An accepted registration is not overruled by the mask: the difference is a remark only. Nor is
    # another pupil or stop that explains the matrix, because the mask is compared with the file's.
    explained = any(one.preferred and one.key for one in fit.alternatives)
    if not (fit.accepted or of_stop or explained):
        advised = f"{Advice.DO_NOT_USE}: {difference}"
        fit = replace(fit, recommendation=advised, corrections={})
    return replace(fit, remarks=remarks)


def _remove_smear(
    models: FitModels,
    instrument: Instrument,
    found: _Found,
    usable: Reference,
    first: Smear,
    options: FitOptions,
    report_stage: Progress,
) -> tuple[_Found, Reference]:
    """Return the fit with the remainder of each previous poke removed from the columns.

    The registration itself follows part of the smear, so the first measurement is too small. Secant
    steps find the share at which none remains. If that does not explain the matrix clearly better,
    the original fit is returned.
    """
    begin = instrument.with_anamorphosis(found.settled.solution.alpha)
    # The first secant begins without removal, where the whole measured share is left.
    before, left_before, share = 0.0, first.share, first.share
    again, sigma = found, first.sigma
    for _ in range(_SMEAR_STEPS):
        if not 0.0 < share <= MAX_SMEAR:
            return found, usable  # the secants diverged: the residual has another cause
        cleaned = remove_smear(usable, share)
        # A whole fit for each trial: the registration moves with the share that is removed.
        again = _run_method(models, target_of(cleaned, instrument), begin, options, report_stage)
        left = measure_smear(again.settled.solution, again.settled.target)
        rate = (left.share - left_before) / (share - before)
        # The share left over changes by ``rate`` for each unit removed, so σ of the removed share
        # is that of the measured one over the rate.
        sigma = left.sigma / max(abs(rate), _LEAST_RATE)
        # removing more must leave less; a rate of the other sign is noise
        if abs(left.share) < max(left.sigma, _SMEAR_SETTLED) or rate >= 0.0:
            break
        step = float(np.clip(-left.share / rate, -_LONGEST_SMEAR_STEP, _LONGEST_SMEAR_STEP))
        before, left_before, share = share, left.share, min(share + step, MAX_SMEAR)
    # Any additional unknown explains a little: it must explain a tenth of the residual.
    if again.settled.share > _SMEAR_EXPLAINS * found.settled.share:
        return found, usable
    # The solution with the original columns is kept: how far α has moved since then gives the part
    # of σ that belongs to the share.
    again = replace(again, smear=Smear(share=share, sigma=sigma), before=found.settled.solution)
    return again, remove_smear(usable, share)


def _remove_noise(usable: Reference, noisy: NDArray[np.bool_]) -> Reference:
    """Return the reference without the columns that hold noise only; these are listed."""
    named = list_first(usable.columns[noisy], _MAX_LISTED)
    left_out = f"{int(noisy.sum())} of {len(noisy)} columns hold noise only: modes {named}"
    return usable.column_subset(~noisy, left_out)


def _stroke_known(instrument: Instrument) -> bool:
    """Return True if the amplitude of a column is known: stroke and wavelength both scale it."""
    return instrument.mirror.stroke_known and "wfs.wavelength_m" not in instrument.unknown


def _fix_mask(instrument: Instrument) -> Instrument:
    """Return the instrument with its mask computed once, because every model of the fit uses it."""
    mask = rtc_valid_subapertures(instrument)
    return replace(instrument, wfs=replace(instrument.wfs, valid_subapertures=mask))


def _select_modes(reference: Reference, modes: NDArray[np.intp] | None) -> Reference:
    """Return only the columns of these modes.

    Raises
    ------
    ModelError
        If one of them was not measured.
    """
    if modes is None:
        return reference
    place = {int(mode): column for column, mode in enumerate(reference.columns)}
    missing = [int(mode) for mode in modes if int(mode) not in place]
    if missing:
        raise ModelError(
            f"modes: {missing[0]} is requested and was not measured; expected some of the "
            f"{len(place)} that were ({min(place)} to {max(place)})"
        )
    return reference.column_subset(np.array([place[int(mode)] for mode in modes], dtype=np.intp))


def _remove_shapeless(reference: Reference, instrument: Instrument) -> Reference:
    """Return only the columns of modes that have a usable shape in the instrument file."""
    flat = np.isin(reference.columns, instrument.mirror.flat_modes)
    # A matrix of another shape is left to ``check_reference``, which reports it.
    if not flat.any() or flat.all() or reference.matrix.shape[1:] != flat.shape:
        return reference
    named = list_first(reference.columns[flat], _MAX_LISTED)
    return reference.column_subset(
        ~flat, f"without a usable shape in the instrument file: modes {named}"
    )


FAR_SUBAP = 2.0
"""Shift at which the orientation search is repeated if none explains the lowest orders,
subapertures."""


EQUAL_CORRELATION = 0.02
"""Largest difference of two correlations that rounding of the angles causes."""


def _find_axes_and_sensor(
    instrument: Instrument, usable: Reference, basis: Basis, options: FitOptions, mapper: Mapper
) -> tuple[Instrument, _Axes]:
    """Return the axes of the slopes, and the instrument with the sensor number that shows them.

    An unmodulated matrix resembles a modulated one little, and in no orientation: where none is
    found with the usual value of an unknown modulation, others are tried.
    """
    usual = _find_axes(instrument, usable, basis, options, mapper)
    key = kind_of(instrument).find_fitted_key(instrument.wfs)
    if not usual[2].reason or f"wfs.{key}" not in instrument.unknown:
        return instrument, usual
    for number in OTHER_SENSOR_NUMBERS:
        other = replace(instrument, wfs=replace(instrument.wfs, **{str(key): number}))
        found = _find_axes(other, usable, basis, options, mapper)
        if not found[2].reason:
            return other, found
    return instrument, usual


class AxesDoubt(NamedTuple):
    """Reason why the axes of the slopes are uncertain; empty if they are not."""

    reason: str = ""
    entry: str = ""
    """Entry of the instrument file that explains the matrix better; empty if there is none."""


def _find_axes(
    instrument: Instrument, usable: Reference, basis: Basis, options: FitOptions, mapper: Mapper
) -> _Axes:
    """Return the slope recipe, the start pose, and the reason if the axes are uncertain.

    The last are the smooth combinations of modes that the search compared.

    The search also determines the rotation, so it is skipped only if both orientation and start are
    given. It is made around the start, because a mirror displaced by subapertures has different
    lowest orders.
    """
    stated = options.orientation or instrument.slopes.orientation
    slopes = replace(instrument.slopes, orientation=stated)
    if stated is not None and options.start is not None:
        return slopes, None, AxesDoubt(), None
    about, coarse = options.start or instrument.start, coarse_model(instrument, basis, mapper)

    def search_about(place: Misregistration, setting: Orientation | None) -> Search:
        seen = replace(instrument, slopes=replace(slopes, orientation=setting))
        return find_orientation(seen, usable, basis, mapper=mapper, about=place, coarse=coarse)

    search = search_about(about, stated)
    if options.start is None and search.best.correlation < DOUBTFUL_CORRELATION:
        # Only without a given start, because the corners take eight further searches.
        corners = [
            about.with_vector(about.vector + FAR_SUBAP * np.array([x, y, 0.0, 0.0]))
            for x, y in product((-1.0, 0.0, 1.0), repeat=2)
            if x or y
        ]
        far = {place: search_about(place, stated) for place in corners}
        most = max(one.best.correlation for one in far.values())
        # rotated by 180 deg together with the axes, the same mirror is at the opposite shift
        alike = [one for one in far if far[one].best.correlation > most - EQUAL_CORRELATION]
        # Of equal explanations the one with the fewest changes of the axes and the smallest
        # rotation is the likeliest.
        place = min(alike, key=lambda one: far[one].best.effort)
        if far[place].best.correlation > search.best.correlation + 2.0 * MIN_CORRELATION_LEAD:
            about, search = place, far[place]
    best = search.best
    # A weak correlation gives no rotation: the fit then starts from the file's values.
    sure = best.correlation >= MIN_CORRELATION
    pose = replace(about, rotation_rad=best.rotation_rad) if sure else None
    if stated is None:
        return best.slopes, pose, AxesDoubt(search.refusal), search.lowest
    if best.correlation >= DOUBTFUL_CORRELATION:
        return best.slopes, pose, AxesDoubt(), search.lowest
    # A stated orientation is compared with a free search only if it explains the lowest orders
    # badly: that search tries every orientation and order.
    # Around the start again: a corner that suits a wrong orientation best suits no other one.
    free = search_about(options.start or instrument.start, None).best
    doubt = check_stated_orientation(best, free)
    entry = format_setting(free.slopes) if doubt else ""
    return best.slopes, pose, AxesDoubt(doubt, entry), search.lowest


_Axes = tuple[SlopeRecipe, Misregistration | None, AxesDoubt, LowOrder | None]
"""Result of ``_find_axes``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """Result of one of the methods."""

    settled: Settled
    landing: Landing | None = None
    table: tuple[ScanStep, ...] | None = None
    smear: Smear | None = None
    """Share of the previous column that was removed from each column."""

    before: Solution | None = None
    """Solution with the original columns, if a smear was removed."""

    even: Solution | None = None
    """Solution with even light, if uneven light was found."""

    edges: Array | None = None
    """``(n_slopes, n_modes)`` addition to the model by turned edges, which the target lacks."""


def _run_method(
    models: FitModels,
    target: Target,
    start: Misregistration,
    options: FitOptions,
    report_stage: Progress,
) -> _Found:
    nuisances = _list_nuisances(models, target, options)
    match options.method:
        case Method.JOINT:
            landing, models, nuisances = land(models, target, start, nuisances)
            settled = settle(models, target, landing.best.alpha, nuisances)
            return _Found(settled=settled, landing=landing)
        case Method.SENSITIVITY:
            # From one start, as the method is used at the AOF, so there are no other minima to
            # compare.
            return _Found(settled=project_on_sensitivities(models, target, start, nuisances))
        case Method.PAPER:
            if not _stroke_known(models.instrument):
                raise ModelError(
                    "--method paper: found a matrix whose strokes are unknown; expected slopes per "
                    "metre, because the paper's criterion leaves no gain free. Use --method joint"
                )
            alpha, table = scan(models, target, start, progress=report_stage)
            return _Found(settled=settle_at(models, target, alpha, nuisances), table=table)


def _list_nuisances(models: FitModels, target: Target, options: FitOptions) -> Nuisances:
    """Return the unknowns that are fitted together with the registration."""
    return nuisances_of(
        target.valid,
        models.instrument.slopes.kind,
        gain_map=options.gain_map,
        anamorphosis=options.anamorphosis,
        nominal=models.instrument.with_anamorphosis(models.instrument.start),
        optics=models.optics,
        unknown=models.unknown,
        **_unknown_images(models),
    )


def _unknown_images(models: FitModels) -> dict[str, Any]:
    """Return the displacement patterns of the pupil images and their σ, if they are unknown."""
    instrument, kind = models.instrument, kind_of(models.instrument)
    sigma = kind.image_sigma_subap(instrument)
    if sigma is None:
        return {}
    # All images together: the models have them where the mask shows the pupil.
    known = instrument.pupil_shift_subap or kind.pupil_offset(instrument)
    place = known if instrument.stop is Stop.TELESCOPE else None
    return {
        "images": image_patterns(instrument.stop),
        "image_sigma": sigma,
        "displaced": np.repeat(place or (0.0, 0.0), 4),
    }


def _gather_findings(
    as_in_file: FitModels, found: _Found, usable: Reference, axes: AxesDoubt
) -> FitFindings:
    """Return what the verdict rests on: σ with all its parts, and other explanations."""
    settled, solution = found.settled, found.settled.solution
    target, about, seen = settled.target, settled.models.instrument, solution.projection
    power = np.sum(target.matrix[target.rows] ** 2, axis=0)
    structure = measure_structure(seen.residual, power, usable.noise_per_pass)
    before = estimate_uncertainty(settled, structure, _magnification_floor(about)[0])
    optics = list_optics(as_in_file, settled, before, structure)
    # This takes further fits, so only if a fitted value differs notably from the file.
    notable = any(one.notable for one in optics)
    without = fit_file_values(as_in_file, settled, optics) if notable else None
    few = FitSubset(settled)
    tried = find_alternatives(few, optics, without)
    sure = add_alternatives(
        before, tried, settled.share, width=estimate_width_effect(few), without=without
    )
    findings = FitFindings(
        settled=settled,
        structure=structure,
        noise_share=bound_noise_share(seen.residual, solution.matrix[target.rows] * seen.gains),
        uncertainty=sure,
        before=before,
        landing=found.landing,
        alternatives=tried,
        optics=optics,
        narrow=_find_narrow_pupil(settled),
        with_file_values=without,
        axes=axes.reason,
        passes=usable.passes,
        stroke_known=_stroke_known(about),
        # large pokes look like a wider modulation, which the fit may have taken for the true one
        weakly_modulated=any(
            kind_of(one).is_weakly_modulated(one.wfs) for one in (about, as_in_file.instrument)
        ),
    )
    moves = np.array([*_list_errors(findings, found), *usable.place_sigma_subap * np.eye(4)[:2]])
    return replace(findings, uncertainty=sure.with_moves(moves, np.ones(len(moves))))


def _list_errors(findings: FitFindings, found: _Found) -> Iterator[Array]:
    """Yield 1 σ of the registration ``(4,)`` from each error that no alternative covers."""
    settled, solution = found.settled, found.settled.solution
    about, nuisances = settled.models.instrument, settled.nuisances
    if found.smear is not None and found.before is not None:
        # The registration moves in proportion to the share that is removed.
        yield (solution.vector - found.before.vector) * found.smear.sigma / found.smear.share
    if found.even is not None:
        # Whether the gain is that of light, a matrix does not show.
        yield solution.vector - found.even.vector
    yield _misplacement_sigma(about, findings.structure)
    # Tilted faces of a pyramid displace its images and also turn the edges between the faces. The
    # model contains the displacement only.
    images = nuisances.images.T @ solution.nuisances[nuisances.image_places]
    share = 1.0 if found.edges is None else _EDGE_ERROR
    yield share * kind_of(about).turned_edge_sigma(about, images.reshape(2, 4).T)
    if findings.weakly_modulated:
        yield nonlinearity_sigma(settled.share, findings.noise_share)


def _make_fit(
    found: _Found,
    usable: Reference,
    findings: FitFindings,
    grounds: Grounds,
    options: FitOptions,
) -> Fit:
    settled, solution = found.settled, found.settled.solution
    target, about, seen = settled.target, settled.models.instrument, solution.projection
    nuisances, sure = settled.nuisances, findings.uncertainty
    matrix, measured = solution.matrix, target.matrix
    if found.edges is not None:
        matrix = matrix + found.edges.astype(matrix.dtype)
        measured = measured + found.edges * seen.gains
    stretch_sigma = nuisances.stretch_sigma(sure.nuisance_sigma)
    determined = grounds.refusal is None
    return Fit(
        alpha=solution.alpha,
        covariance=sure.covariance,
        gains=seen.gains,
        residual_fraction=settled.share,
        residual_map=settled.residual_map,
        residual_by_mode=settled.by_mode,
        condition_number=_condition_number(matrix),
        modes=target.modes,
        orientation=about.slopes.assumed_orientation,
        order=about.slopes.order,
        subset_scatter=sure.subset_scatter,
        accepted=determined,
        converged=solution.converged,
        verdict=f"{'accepted' if determined else 'refused'}: {grounds.reason.words}",
        remarks=(),
        left_out=(*usable.left_out, *_rows_left_out(target, about)),
        n_evaluations=settled.models.counter.n,
        synthetic=matrix,
        measured=measured,
        valid=target.valid,
        gain_map=nuisances.gain_map(solution.nuisances, target.valid),
        # misplaced actuators stretch the image as much as they turn it
        anamorphosis_sigma=None
        if stretch_sigma is None
        else np.hypot(stretch_sigma, _misplacement_sigma(about, findings.structure)[2]),
        image_offsets_px=_image_offsets(about, nuisances, solution),
        # values fitted to noise are not reported
        optics=findings.optics if findings.explained else (),
        alternatives=findings.alternatives,
        registration=Registration(
            determined=determined,
            reason=grounds.reason.words,
            sigma_statistical=sure.sigma_statistical,
            sigma_systematic=sure.sigma_systematic,
            sets=sure.sets,
            distortion=sure.distortion,
        ),
        reconstructor=check_control(
            measured,
            matrix,
            seen.gains,
            target.modes,
            target.rows,
            gain=options.gain,
            noise=usable.noise_per_pass,
        ),
        # Parts of a residual mean nothing where the model explains hardly anything.
        causes=explain_left_over(settled, usable.noise_per_pass)
        if options.explain and findings.explained
        else (),
        paper_table=found.table,
    )


def _gather_grounds(
    findings: FitFindings, found: _Found, axes: AxesDoubt, *, explain: bool
) -> Grounds:
    """Return the verdict, and what a recommendation needs besides the fit's numbers."""
    settled, without = found.settled, findings.with_file_values
    refusal, reason = judge_fit(findings)
    # Columns are compared with the model at α, which means nothing where the fit found none.
    compared = findings.explained and settled.solution.converged
    causes = find_gain_causes(settled, passes=findings.passes, stroke_known=findings.stroke_known)
    return Grounds(
        refusal=refusal,
        reason=reason,
        structure=findings.structure,
        n_sets=len(findings.uncertainty.subset_steps),
        columns=tuple(find_strange_columns(settled.solution, settled.target)) if compared else (),
        axes_entry=axes.entry,
        numbers_share=1.0 if without is None else 1.0 / without.misfit,
        gains=tuple(causes) if explain else (),
        noise_share=findings.noise_share,
        large_pokes=findings.weakly_modulated and without is not None and may_compensate(without),
    )


def _add_notes(
    fit: Fit,
    found: _Found,
    findings: FitFindings,
    grounds: Grounds,
    about: Instrument,
    reported: SlopeRecipe,
) -> Fit:
    """Return the fit with its notes, and with the values of the file that it determined.

    ``about`` is the instrument as the file describes it, ``reported`` its slopes as requested.
    """
    slopes = found.settled.models.instrument.slopes
    floor, words = _magnification_floor(found.settled.models.instrument)
    remarks = (
        *collect_remarks(
            findings, reported=reported, found=slopes, about=found.settled.models.instrument
        ),
        *grounds.columns,
        *(() if found.smear is None else (found.smear.words,)),
        *(() if found.even is None else (LIGHT_FOUND_WORDS,)),
        *((words,) if words and floor**2 > fit.covariance[3, 3] / 2.0 else ()),
    )
    origins: tuple[Origin, ...] = ()
    if findings.explained:
        stroke = find_stroke(about, slopes, fit.gains, findings.optics, findings.structure)
        fit = replace(fit, stroke=stroke)
        origins = list_origins(
            about,
            reported,
            slopes,
            findings.optics,
            findings.with_file_values,
            findings.structure,
            fit.gains,
        )
        settled, sigma = found.settled, findings.uncertainty.nuisance_sigma
        # The two axes of an ellipse take the place of the radius.
        radius = settled.models.sensor_key if Optic.STRETCH in settled.models.optics else None
        families = find_families(settled, sigma, findings.structure)
        origins = (*(one for one in origins if one.key != radius), *families)
    unknown = list_undetermined_keys(about, origins)
    return replace(fit, remarks=remarks, origins=origins, unknown_not_found=unknown)


def _magnification_floor(instrument: Instrument) -> tuple[float, str]:
    """Return the smallest 1 σ of a magnification, and the reason if it is larger than usual."""
    if instrument.slopes.normalisation is Normalisation.LOCAL:
        floor = LOCAL_MAGNIFICATION_FLOOR
        cause = "each subaperture is divided by its own light, which lets its border weigh as much"
    elif kind_of(instrument).is_weakly_modulated(instrument.wfs):
        floor = WEAK_MODULATION_FLOOR
        cause = "the modulation is at most 1.5 λ/D, where models sample the focus differently"
    else:
        return MAGNIFICATION_FLOOR, ""
    return floor, (
        f"sigma of the magnification is mostly a floor of {floor:.1%}: {cause}, and matrices of "
        "such sensors differ by 0.1 to 0.3 % from their model"
    )


def _misplacement_sigma(instrument: Instrument, structured: float) -> Array:
    """Return 1 σ from misplaced actuators; 0 where sets of actuators show it or none are drawn."""
    mirror = instrument.mirror
    if not isinstance(mirror, Mirror) or is_by_actuator(instrument):
        return np.zeros(4)
    radius_m = instrument.wfs.pupil_diameter / 2.0 * instrument.subaperture_m
    return misplacement_sigma(mirror, radius_m, instrument.subaperture_m, structured)


def _image_offsets(
    instrument: Instrument, nuisances: Nuisances, solution: Solution
) -> Array | None:
    """Return the fitted pupil image offsets, as the instrument file's key gives them.

    None if they were not fitted.
    """
    if not len(nuisances.images):
        return None
    found = nuisances.image_offsets(solution.nuisances)
    return kind_of(instrument).offsets_px(instrument, found)


def _find_narrow_pupil(settled: Settled) -> SeenPupil | None:
    """Return the pupil image if it is narrower than in the instrument file, else None."""
    target, solution = settled.target, settled.solution
    # Gains included: the measured columns contain them, the model's do not.
    squares = solution.projection.gains**2
    measured = np.einsum("ij,ij->i", target.matrix, target.matrix)
    # Slopes that were left out but not silent are unknown: NaN, and not zero response.
    counted = np.where(target.rows | (measured == 0.0), 1.0, np.nan)
    expected = np.einsum("ij,ij,j->i", solution.matrix, solution.matrix, squares)
    answers = compute_responses(measured * counted, expected * counted, target.valid)
    return measure_pupil(answers, settled.models.instrument.wfs.pupil_diameter)


def _rows_left_out(target: Target, instrument: Instrument) -> Iterator[str]:
    """Yield the number of unused slopes and the reason."""
    n_all, n_left_out = len(target.rows), int(np.sum(~target.rows))
    of_sensor = kind_of(instrument).left_out(instrument)
    if of_sensor is not None:
        n = int(of_sensor.subapertures.sum()) * instrument.slopes.kind.n_planes
        yield f"{n} of {n_all} slopes: {of_sensor.reason}"
        n_left_out -= n
    if n_left_out > 0:
        yield f"{n_left_out} of {n_all} slopes: silent, or seen against unknown surface"


def _condition_number(matrix: NDArray[np.float32]) -> float:
    """Return the ratio of the extreme singular values.

    The Gram matrix is precise enough below 1e6.
    """
    columns = matrix.astype(np.float64)
    power = np.linalg.eigvalsh(columns.T @ columns)
    return float(np.sqrt(power[-1] / power[0])) if power[0] > 0.0 else float("inf")
