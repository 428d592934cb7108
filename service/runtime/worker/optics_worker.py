"""The jobs of the worker: fit windows, compute and judge reconstructors."""

from __future__ import annotations

import hashlib
import itertools
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.control.dither import compute_information
from service.control.expected_gain import (
    Sky,
    estimate_slope_noise,
    extrapolate_variance_m2,
    predict_gain,
)
from service.control.gains import CalibrationGains
from service.control.gate import judge
from service.control.loop import ControlLoop
from service.control.reconstructor import InversionMethod, Prior, Recipe, reconstruct
from service.control.references import (
    compute_references,
    holding_gain,
    limit_shape,
    shape_in_modes,
)
from service.estimation import passive
from service.estimation.description import Description
from service.estimation.dithered_response import DitheredResponse, ModeResidual
from service.estimation.lockin import Spectra, fit_window
from service.estimation.openloop import WideCaptureSearch, far_starts, find, not_found
from service.estimation.own_matrix import (
    LeftOver,
    OwnMatrix,
    left_over,
    recognise_modes,
    weights_of_modes,
)
from service.estimation.random_dither import Correlated, fit_random
from service.estimation.slope_convention import (
    RESPONSE_RATIO_RANGE,
    SlopeConvention,
    identify_from_reconstructor,
    identify_from_response,
)
from service.estimation.windows import ClosedLoop
from service.files.disk_cache import DiskCache
from service.model.instrument import Instrument
from service.model.interaction import Linearisation, RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import WorkingPoint
from service.model.slopes import Orientation
from service.records.estimates import (
    DitheredEstimate,
    LockInEstimate,
    PassiveEstimate,
    RandomEstimate,
    RefusalKind,
    WideCaptureEstimate,
    WindowRefused,
)
from service.records.messages import as_message, compose
from service.records.products import ExpectedGain, GateVerdict, Shape, ShapeKind
from service.records.state import ModelState
from service.runtime.worker.records import (
    Compute,
    Conditions,
    Made,
    MadeReferences,
    actuators_of,
    check_controllable,
    largest_passing,
    outer_of,
    waits,
)
from service.runtime.worker.rows import SharedRows
from service.runtime.worker.sensor import MAX_LINEAR_STEPS, SensorAtWork, length, settled

MAX_COARSE_STEPS = 12
"""Steps of the coarse model. From the edge of the capture range three are enough where the model
is right. Where it is 20 to 40 % wrong per mode a step is 0.6 times the last: eight are needed."""

MAX_MISFIT_RISE_RATIO = 1.02
"""A step that raises the misfit by more than this factor, and is not shorter than the last, has
left the minimum: the fit has failed."""

MAX_REFINEMENTS = 4
"""Linearisations of the fine model about the estimate of the last, until one settles."""

NOMINAL_RESPONSE_TOLERANCE = 0.15
"""Relative difference of a mode's response from the model's below which it counts as equal: noise
and the model's own error are of this size."""

MAX_FIT_DISTANCE = np.array([1.5, 1.5, np.deg2rad(6.0), 0.05])
"""An estimate further than this from its start has diverged (numeric units)."""

Dithered = TypeVar("Dithered", bound=DitheredEstimate)


class OpticsWorker:
    """The optical model and the last linearisation, kept between jobs.

    Telemetry, and the stability of a loop, are of the sensor as it works; what is published is the
    inverse of its response to a flat wavefront: the optical gain is never folded in. Every optical
    gain that comes or goes is relative to that flat response.
    """

    def __init__(self, instrument: Instrument, compute: Compute) -> None:
        check_controllable(instrument, compute)
        self._disk_cache = DiskCache(compute.cache)
        self.rows = SharedRows(compute.threads, compute.cluster)
        self._compute = compute
        self._file = instrument
        self._basis = self._disk_cache.basis(instrument)
        self._state = ModelState()
        self.arrays: dict[str, Any] = {}
        """Measured residuals by the keys in the state."""

        self._equip(self._state)

    @property
    def state(self) -> ModelState:
        """State of the model on which the results of the next job depend."""
        strength, linearised_at = self._sensor.place
        return replace(self._state, strength=strength, linearised_at=linearised_at)

    def restore(self, state: ModelState, arrays: Mapping[str, Any]) -> None:
        """Continue from a state of the model, whatever this worker has done before.

        ``arrays`` are those of the state that this worker may not have.

        Raises
        ------
        ModelError
            If the instrument has no such mode of the sensor.
        """
        known = self.arrays | dict(arrays)
        self.arrays = {key: known[key] for key in state.keys}
        if _parts_of_models(state) != _parts_of_models(self._state):
            self._equip(state)
        self._state = state
        self._sensor.restore(state.strength, state.linearised_at)

    def _equip(self, state: ModelState) -> None:
        """Make the models for a mode of the sensor, slopes and a response of modes."""
        compute, instrument = self._compute, self._file
        if state.sensor_mode not in {None, instrument.config_id}:
            instrument = instrument.in_mode(state.sensor_mode)
        if state.slopes is not None:
            order, axes = SlopeOrder(state.slopes[0]), dict[str, Any](state.slopes[1])
            found = replace(instrument.slopes, order=order, orientation=Orientation(**axes))
            instrument = replace(instrument, slopes=found)
        if state.sensor_mode != self._state.sensor_mode:
            self._basis = self._disk_cache.basis(instrument)
        basis = self._basis
        response = None if state.response is None else np.array(state.response)

        def model(sampling: int, nodes: int, at_work: WorkingPoint | None) -> RtcInteractionModel:
            return RtcInteractionModel(
                instrument,
                basis,
                pupil_sampling=sampling,
                detector_nodes=nodes,
                working_point=at_work,
                kept_bytes=compute.kept_bytes,
                mapper=self.rows.map,
                mode_response=response,
                anamorphosis=compute.anamorphosis,
                arrays=compute.arrays,
            )

        sampling, nodes, working_point_modes = compute.sampling
        self._sensor = SensorAtWork(
            lambda at_work: model(sampling, nodes, at_work),
            instrument,
            working_point_modes,
            sampling * instrument.binning,
        )
        self._model = self._sensor.flat
        kind = kind_of(instrument)
        # Biased by 0.05 % of a subaperture, and four times as fast; the model that leads from afar
        # by some per cent.
        coarse = kind.derivative_sampling(instrument.wfs)
        self._samplings = (kind.coarsest_sampling(instrument.wfs), coarse)
        self._coarse = model(coarse, coarse, None)
        self._start = instrument.with_anamorphosis(instrument.start)
        self._wide_capture: dict[tuple[int, ...], tuple[RtcInteractionModel, ...]] = {}

    def tidy(self) -> None:
        """Give back the memory of what a job leaves and the next one hardly ever needs."""
        models = (self._coarse, *itertools.chain.from_iterable(self._wide_capture.values()))
        for model in (*self._sensor.models, *models):
            model.forget()

    def describe(self) -> Description:
        """Return the expected telemetry, and prepare for the first fit."""
        linearisation, model = self._first(), self._model
        self._sensor.keep(linearisation)
        return Description(
            n_slopes=model.n_slopes,
            n_modes=model.basis.n_modes,
            mode_variance_m2=model.basis.variance_m2,
            actuators=actuators_of(model),
            mode_information=compute_information(linearisation),
            kind=model.instrument.slopes.kind,
            products=linearisation.matrix.T @ linearisation.matrix,
            diameter_m=model.instrument.diameter_m,
            start=self._start,
        )

    def _first(self) -> Linearisation:
        """Return the linearisation about the nominal registration, prepared once for all."""
        start = self._start

        def computed() -> dict[str, NDArray[np.float32]]:
            found = self._sensor.compute(start)
            return {name: getattr(found, name) for name in names}

        names = ("matrix", "derivatives", "stretches")[: 3 if self._compute.anamorphosis else 2]
        of = (start.vector.tolist(), *names[2:], self.state.strength, self.state.response)
        what = ("linearisation", *self._compute.sampling, *of)
        kept = self._disk_cache.arrays(self._model.instrument, what, computed)
        return Linearisation(alpha=start, **kept, noise_shape=self._model.noise_shape)

    def fit(
        self, spectra: Spectra, loop: ClosedLoop, start: Misregistration | None
    ) -> LockInEstimate | WindowRefused:
        """Estimate α from one window, from ``start`` or, without one, from the nominal rotation.

        Where the linearisation at hand is too far away, the coarse model leads to within reach of
        one new, fine linearisation. A working point that does not give the optical gains that were
        measured is followed first. Slopes of another instrument are refused: what they look like.
        The residual of every accepted fit is kept for the gate.
        """
        outcome = self._fit_recognised(spectra, loop, start)
        # Not a new linearisation about the estimate: the fit has done without it.
        near = self._sensor.at_hand
        if isinstance(outcome, LockInEstimate) and near is not None:
            at_work = self._with_own_residual(self._sensor.to_unit_gain(near))
            dithered = self._dithered
            dithered.add(spectra, outcome, at_work.matrix_at(outcome.alpha))
            self._keep_dithered(dithered)
        return outcome

    def _fit_recognised(
        self, spectra: Spectra, loop: ClosedLoop, start: Misregistration | None
    ) -> LockInEstimate | WindowRefused:
        """Return the fit of a window, or why its slopes are another instrument's."""
        begun = start or self._start
        outcome = self._fit_spectra(spectra, loop, begun)
        if isinstance(outcome, LockInEstimate):
            gains = outcome.optical_gain
            if (
                # The real part, because a response of the wrong sign has a large magnitude too.
                gains.real.min() > RESPONSE_RATIO_RANGE[0]
                and np.abs(gains).max() < RESPONSE_RATIO_RANGE[1]
            ):
                return outcome
            begun = outcome.alpha
        seen = spectra.commands[:, 0] @ self._sensor.near(begun).matrix.T
        turns = 2 * np.pi * np.array(spectra.plan.frequencies_hz) / spectra.plan.frame_rate_hz
        answer = identify_from_response(spectra.slopes[:, 0], seen, turns, self._model.instrument)
        if not answer.wrong:
            return outcome
        reason = compose("window.other-instrument", text=answer.wrong)
        return spectra.refuse(reason, RefusalKind.MISDESCRIBED)

    def _fit_spectra(
        self, spectra: Spectra, loop: ClosedLoop, start: Misregistration
    ) -> LockInEstimate | WindowRefused:
        try:
            estimate = self._refine_fit(spectra, loop, start)
            if estimate is None:
                return _refuse_unsettled(spectra)
            found = self._against_flat(estimate)
            if self._sensor.follow(found.modes, found.optical_gain):
                estimate = self._refine_fit(spectra, loop, found.alpha)
        except np.linalg.LinAlgError as error:
            return spectra.refuse(compose("window.no-fit", str(error)))
        return _refuse_unsettled(spectra) if estimate is None else self._against_flat(estimate)

    def read_slope_convention(
        self, in_use: NDArray[np.float32], near: Misregistration | None
    ) -> SlopeConvention:
        """Compare the RTC's own matrix with the instrument file.

        Where the file leaves the orientation open, what is found is taken over.
        """
        at, instrument = near or self._start, self._model.instrument
        result = identify_from_reconstructor(
            in_use,
            instrument,
            self._basis,
            near=at,
            response=self._sensor.at_unit_gain(at).matrix,
            mapper=self.rows.map,
        )
        if instrument.slopes.orientation is not None or result.found is None or result.wrong:
            return result
        axes = tuple(asdict(result.found.assumed_orientation).items())
        self._rebuild(replace(self._state, slopes=(result.found.order, axes)))
        return replace(result, adopted=True)

    def _rebuild(self, state: ModelState) -> None:
        """Make the models again with the slopes or the response of modes of a state."""
        # What dithers have shown is a residual of the models before.
        self.restore(replace(state, dithered=(), strength=1.0, linearised_at=None), {})

    def recognise(
        self, own: NDArray[np.float32], near: Misregistration | None, rotation_rad: float | None
    ) -> OwnMatrix | None:
        """Return the modes that the RTC's own matrix controls; None if it controls none.

        ``rotation_rad`` is the rotation found in a coarser search, None without one. If the
        response of a mode differs from the nominal one, though with its own sign and in its own
        place, the model adopts it: later matrices allow for it.
        """
        start = near or self._start
        if near is None and rotation_rad is not None:
            start = replace(start, rotation_rad=rotation_rad)
        found = recognise_modes(own, self._coarse.linearise, start)
        # A residual of the matrix before must not widen the verdicts on this one.
        self._state = replace(self._state, own_matrix_read=True, own_residual=None)
        if found is None or found.wrong or not found.known.any():
            return found
        power = np.square(self._first().matrix).sum(axis=0)
        found = replace(found, weights=weights_of_modes(found, power))
        response = found.response[found.known]
        if np.any(np.abs(response - 1.0) > NOMINAL_RESPONSE_TOLERANCE):
            n_modes = self._basis.n_modes
            gains = CalibrationGains.of_modes(response, found.columns[found.known], n_modes).values
            # The matrix was compared with a model that already contains the response found before:
            # the factors multiply.
            now = 1.0 if self._state.response is None else np.array(self._state.response)
            self._rebuild(replace(self._state, response=tuple((now * gains).tolist())))
        left = left_over(own, found, self._coarse.interaction_matrix(found.alpha))
        if left is not None:
            self._state = replace(self._state, own_residual=self._keep(left))
        return found

    def _refine_fit(
        self, spectra: Spectra, loop: ClosedLoop, start: Misregistration
    ) -> LockInEstimate | None:
        """Return the fit about a linearisation that is near enough to it; None: there is none."""
        estimate = fit_window(spectra, self._sensor.near(start), loop)
        if length(estimate.step) > MAX_LINEAR_STEPS:
            near = self._approach(spectra, loop, estimate, start)
            if near is None:
                return None
            estimate = fit_window(spectra, self._sensor.linearise(near), loop)
        for _ in range(MAX_REFINEMENTS):
            if settled(estimate) or length(estimate.step) > MAX_LINEAR_STEPS:
                break
            # near enough; or the coarse model's bias, flat as it is, was more than what settles
            estimate = fit_window(spectra, self._sensor.linearise(estimate.alpha), loop)
        return estimate if settled(estimate) else None

    def find(
        self,
        spectra: Spectra,
        start: Misregistration | None,
        flux: bytes | None,
        nominal: Misregistration | None = None,
    ) -> WideCaptureEstimate | WindowRefused:
        """Find α in a window with the loop open; without a start from anywhere about ``nominal``.

        ``flux`` is the RTC's: where the pupil images move with the mirror's they are a start.
        """
        modes = spectra.plan.modes
        # Kept between attempts of an acquisition, which dither the same modes each time.
        if modes not in self._wide_capture:
            basis, every = self._model.basis.subset(np.array(modes)), self._state.response
            self._wide_capture[modes] = tuple(
                RtcInteractionModel(
                    self._model.instrument,
                    basis,
                    pupil_sampling=sampling,
                    detector_nodes=sampling,
                    mapper=self.rows.map,
                    mode_response=None if every is None else np.array(every)[list(modes)],
                )
                for sampling in self._samplings
            )
        far, near = self._wide_capture[modes]
        instrument, nominal = self._model.instrument, nominal or self._start
        starts = (start,) if start is not None else far_starts(instrument, flux, nominal)
        try:
            return find(
                spectra,
                WideCaptureSearch(coarse=far, fine=near, nominal=nominal, starts=starts),
            )
        except np.linalg.LinAlgError as error:
            return not_found(as_message("not-found.failed", str(error)), spectra)

    def fit_random(
        self, window: Correlated, start: Misregistration | None
    ) -> RandomEstimate | WindowRefused:
        """Estimate α from one window of random dither, from ``start`` as in :meth:`fit`."""
        try:
            estimate = fit_random(window, self._sensor.near(start or self._start))
            for _ in range(MAX_COARSE_STEPS):
                if isinstance(estimate, WindowRefused):
                    return estimate
                if settled(estimate):
                    return self._against_flat(estimate)
                begun = start or self._start
                if np.any(np.abs(estimate.alpha.vector - begun.vector) > MAX_FIT_DISTANCE):
                    break
                estimate = fit_random(window, self._sensor.linearise(estimate.alpha))
        except np.linalg.LinAlgError as error:
            return window.refuse(compose("window.no-fit", str(error)))
        return _refuse_unsettled(window)

    def response(self, alpha: Misregistration | None) -> NDArray[np.float32]:
        """Return D(α) to a flat wavefront, ``(n_slopes, n_modes)``, slope per metre OPD.

        None: at the nominal registration.
        """
        return self._model.interaction_matrix(alpha or self._start)

    def _against_flat(self, estimate: Dithered) -> Dithered:
        """Return the estimate with its gains relative to the flat response, not that at work."""
        ratio = self._sensor.ratio()[list(estimate.modes)]
        sigma = estimate.gain_sigma
        return replace(
            estimate,
            optical_gain=estimate.optical_gain * ratio,
            gain_sigma=None if sigma is None else sigma * ratio,
        )

    def _approach(
        self,
        spectra: Spectra,
        loop: ClosedLoop,
        estimate: LockInEstimate,
        start: Misregistration,
    ) -> Misregistration | None:
        """Return where the coarse model's steps lead; None when they do not shrink."""
        for _ in range(MAX_COARSE_STEPS):
            if np.any(np.abs(estimate.alpha.vector - start.vector) > MAX_FIT_DISTANCE):
                return None
            before, misfit = length(estimate.step), estimate.misfit
            estimate = fit_window(spectra, self._coarse.linearise(estimate.alpha), loop)
            if length(estimate.step) <= MAX_LINEAR_STEPS:
                return estimate.alpha
            if length(estimate.step) > before and estimate.misfit > MAX_MISFIT_RISE_RATIO * misfit:
                return None
        return None

    @waits(at_most_s=1.0)
    def make(self, conditions: Conditions, fewer: tuple[int, ...] = ()) -> Made:
        """Compute the reconstructor for α, with as many modes as the loop has gains, and judge it.

        If the gate rejects it, return the one with the most of ``fewer`` modes, largest first, that
        passes; if none passes, the one requested.
        """
        matrix, loop = self._model.interaction_matrix(conditions.alpha), conditions.loop

        def judged(n_modes: int) -> Made:
            inversion = reconstruct(matrix, self._recipe(n_modes))
            of_these = replace(conditions, loop=loop.select_modes(slice(n_modes)))
            verdict = self.judge(inversion.matrix, of_these)
            return Made(
                matrix=inversion.matrix, condition_number=inversion.condition_number, gate=verdict
            )

        return largest_passing(len(loop.gains), fewer, judged)

    def assess(
        self,
        in_use: NDArray[np.float32],
        alpha: Misregistration,
        loop: ControlLoop,
        magnitude: float | None,
    ) -> ExpectedGain | None:
        """Return what a new reconstructor would win over the one in use; None: unknown.

        ``magnitude`` is the star's; None: the noise of the settings.
        """
        model, n_modes = self._model, len(in_use)
        seen = self._sensor.at_unit_gain(alpha).matrix_at(alpha)
        flat = seen if self._sensor.is_flat else model.interaction_matrix(alpha)
        fresh = reconstruct(flat, self._recipe(n_modes)).matrix
        noise, kind = self._compute.slope_noise, model.instrument.slopes.kind
        if magnitude is not None:
            noise = estimate_slope_noise(
                model.instrument,
                magnitude=magnitude,
                frame_rate_hz=loop.frame_rate_hz,
                n_valid=int(model.valid.sum()),
            )
        sky = Sky(
            variance_m2=model.basis.variance_m2,
            beyond_m2=extrapolate_variance_m2(model.basis.variance_m2),
            crossing_hz=self._compute.wind_m_s / model.instrument.diameter_m,
            slope_noise=noise * kind.noise,
        )
        try:
            return predict_gain(in_use, fresh, seen, loop, sky)
        except np.linalg.LinAlgError:
            return None

    def make_references(
        self,
        shape: Shape,
        alpha: Misregistration,
        optical_gain: NDArray[np.float64],
        n_controlled: int,
        worst_seeing_arcsec: float,
    ) -> MadeReferences:
        """Compute the reference slopes that hold a shape, and check its size.

        ``optical_gain`` is that of all modes of the basis, of which the controlled ones hold the
        shape. Slopes are split into what these explain and the rest, scaled by their mean gain.
        """
        model, values = self._model, np.array(shape.values)
        matrix = model.interaction_matrix(alpha)
        left = np.zeros(len(matrix))
        if shape.kind is ShapeKind.SLOPES:
            coefficients = np.zeros(model.basis.n_modes)
            inverse = reconstruct(matrix, self._recipe(n_controlled)).matrix
            coefficients[:n_controlled] = inverse @ values
            left = values - matrix @ coefficients
            unexplained = float(np.linalg.norm(left) / np.linalg.norm(values))
        else:
            if shape.kind is ShapeKind.MAP:
                values = values.reshape(round(len(values) ** 0.5), -1)
            found = shape_in_modes(model, alpha, values, shape.frame, n_modes=n_controlled)
            coefficients, unexplained = found.coefficients_m, found.unexplained
        limit = limit_shape(
            model.instrument,
            model.basis,
            coefficients,
            optical_gain=optical_gain,
            n_controlled=n_controlled,
            worst_seeing_arcsec=worst_seeing_arcsec,
        )
        offset = compute_references(matrix, optical_gain, coefficients)
        offset = offset + holding_gain(optical_gain)[:n_controlled].mean() * left
        power = np.cumsum(np.square(coefficients))
        n_kept = int(np.searchsorted(power, 0.999 * power[-1])) + 1
        return MadeReferences(
            offset=offset.astype(np.float32),
            coefficients_m=tuple(coefficients[:n_kept].tolist()),
            unexplained=unexplained,
            refusal="" if limit.accepted else limit.reason,
        )

    def _recipe(self, n_modes: int) -> Recipe:
        prior = None
        if self._compute.method is InversionMethod.MAP:
            prior = Prior(
                variance_m2=self._model.basis.variance_m2,
                slope_noise=self._model.slope_noise(self._compute.slope_noise),
            )
        return Recipe(
            n_modes=n_modes,
            max_condition=self._compute.max_condition,
            prior=prior,
        )

    def judge(self, reconstructor: NDArray[np.float32], conditions: Conditions) -> GateVerdict:
        """Return whether a reconstructor would hold the loop within α ± 3σ."""
        alpha, noise = conditions.alpha, self._model.instrument.slopes.kind.noise
        loop = replace(conditions.loop, outer=outer_of(self._model), noise=noise)
        found: list[GateVerdict] = []
        for response in self._possible_responses(alpha):
            covariance, bound = conditions.covariance, conditions.bound
            found.append(judge(reconstructor, response, alpha, covariance, loop, bound=bound))
            if not found[-1].accepted:
                return found[-1]
        return max(found, key=lambda verdict: verdict.worst_pole_radius)

    def _possible_responses(self, alpha: Misregistration) -> Iterator[Linearisation]:
        """Yield the responses at unit gain that agree with what was measured of modes."""
        own, at_work = self._left_over, self._with_own_residual(self._sensor.at_unit_gain(alpha))
        dithered = self._dithered
        known = () if own is None else own.columns.tolist()
        # A model that is poor where the RTC's own matrix shows it is taken for poor in all modes:
        # what noise may hide in their measured response counts as the model's error.
        if own is not None and own.is_large(at_work.matrix):
            every = dithered.with_noise(known)
        else:
            significant = dithered.left_over(known)
            every = () if significant is None else (significant,)
        for left in every:
            yield left.add_to(at_work)
        if not every:
            yield at_work

    def _with_own_residual(self, linearisation: Linearisation) -> Linearisation:
        """Return a linearisation at unit gain with the residual of the RTC's own matrix."""
        left = self._left_over
        return linearisation if left is None else left.add_to(linearisation)

    @property
    def _left_over(self) -> LeftOver | None:
        """The model's residual of the RTC's own matrix, which the gate adds to judged loops."""
        key = self._state.own_residual
        return None if key is None else self.arrays[key]

    @property
    def _dithered(self) -> DitheredResponse:
        residuals = {mode: self.arrays[key] for mode, key in self._state.dithered}
        return DitheredResponse(self._state.dither_session, residuals)

    def _keep_dithered(self, found: DitheredResponse) -> None:
        """Store the measured responses of dithered modes, each under its key."""
        keys = dict(self._state.dithered)
        for mode, residual in found.residuals.items():
            if residual is not self.arrays.get(keys.get(mode, "")):
                keys[mode] = self._keep(residual)
        kept = tuple((mode, keys[mode]) for mode in found.residuals)
        self._state = replace(self._state, dither_session=found.session, dithered=kept)

    def _keep(self, arrays: LeftOver | ModeResidual) -> str:
        """Store arrays under a key of their contents, and return it."""
        key = hashlib.blake2b(pickle.dumps(arrays), digest_size=8).hexdigest()
        self.arrays[key] = arrays
        return key

    @waits(at_most_s=10.0)
    def margin(
        self,
        in_use: NDArray[np.float32],
        conditions: Conditions,
        optical_gain: NDArray[np.float64],
        magnitude: float | None,
    ) -> tuple[GateVerdict, ExpectedGain | None]:
        """Return verdict and gain of the matrix in use, ``(n_modes, n_slopes)`` metres per slope.

        ``optical_gain`` ``(n_basis,)`` and the star's ``magnitude`` enter the expected gain.
        """
        verdict = self.judge(in_use, conditions)
        loop = replace(conditions.loop, optical_gain=optical_gain)
        return verdict, self.assess(in_use, conditions.alpha, loop, magnitude)

    @waits(at_most_s=6.0)
    def fit_passive(
        self, sums: passive.Passive, start: Misregistration | None
    ) -> PassiveEstimate | None:
        """Estimate α from ordinary telemetry; None if there is too little of it.

        The fit begins at ``start``, by default at the nominal rotation.
        """
        found = passive.fit(sums, self._sensor.near(start or self._start))
        if found is None:
            return None
        gains = found.optical_gain * self._sensor.ratio()[: sums.n_modes]
        return replace(found, optical_gain=gains)


def _parts_of_models(state: ModelState) -> tuple[object, ...]:
    """Return the parts of the state for which all models are made."""
    return state.sensor_mode, state.slopes, state.response


def _refuse_unsettled(window: Spectra | Correlated) -> WindowRefused:
    return window.refuse(compose("window.unsettled"), RefusalKind.OUT_OF_REACH)
