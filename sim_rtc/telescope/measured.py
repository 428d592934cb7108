"""A telescope whose interaction matrix is a measured one.

The service can be rehearsed with it on the response of a bench before it is connected to it. The
slopes are ``D command + S turbulence + noise``. D is the measured matrix itself. S has two parts:
what the modes can make of the turbulence is seen as the measured matrix says, and the rest of it
(the fitting error, which aliases) is seen as the model of the instrument file says:

    S = K + (D - K Φ) P,

where Φ are the shapes of the modes, P is the least-squares projection of a phase on them and K is
the model's response to any phase. Where the instrument file leaves the orientation of the slopes
open, K cannot be listed as the RTC lists its slopes: then S = D P, and the sensor does not see the
rest of the turbulence.

A movement of the registration changes D by as much as the model's matrix changes: the difference
between measurement and model stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.fitting.fit_file import make_reference
from pyrcal.fitting.recorded import read_recorded
from pyrcal.fitting.report import read_fit
from service.errors import ConfigurationError, MatrixError, ModelError
from service.instrument.paths import TWIN_FIT
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import Basis, ModalBasis
from service.model.pupil import instrument_pupil, rtc_valid_subapertures, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from service.model.slopes import rtc_mask, to_rtc
from sim_rtc.telescope.atmosphere import PhaseResponse
from sim_rtc.telescope.imperfections import SETS, Imperfections, SlopeErrors
from sim_rtc.telescope.linear import LinearOptics, choose_sampling, optical_gain
from sim_rtc.telescope.plant import Plant

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

BENCH_M = 0.5
"""A pupil below this diameter is a bench's, which no star shines on."""

TELESCOPE_M = 8.0
"""Diameter of the telescope that a bench represents unless ``--sky-diameter`` is given."""

_PLAUSIBLE_SIZE = 3.0
"""Ratio of measured to modelled responses, or its inverse, from which on units are in doubt."""

_WEAKEST_SHAPE = 1e-7
"""Share of the strongest combination of modes below which one is no shape of its own."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredMatrix:
    """A measured interaction matrix, one column for each mode that the service controls."""

    matrix: Array
    """``(n_slopes, n_modes)`` slope per metre of command, the mirror seen once, rows as the RTC
    lists its slopes."""

    sha256: str
    """Digest of the file, 64 hexadecimal digits."""

    notes: tuple[str, ...]
    """Decisions about the file, one sentence each."""


def read_measured_matrix(
    path: Path, instrument: Instrument, basis: Basis, *, dataset: str | None = None
) -> MeasuredMatrix:
    """Return the measured matrix in a file that ``pyrcal fit`` can read.

    Columns may be the modes of the instrument file, or its actuators: then the strokes of the modes
    combine them. Detector frames become slopes. If ``mirror.stroke`` is "unknown", one gain, common
    to all columns, gives the matrix the size of the model's.

    Raises
    ------
    ConfigurationError
        If the file cannot be read, holds no finite matrix, or is of another instrument or basis.
    """
    try:
        recorded = read_recorded(path, dataset)
        reference, notes = make_reference(recorded, instrument)
    except (MatrixError, ModelError) as error:
        raise ConfigurationError(f"--matrix: {error}") from error
    matrix = np.asarray(reference.matrix, dtype=np.float64) / reference.passes
    _check(matrix, instrument, recorded.where)
    matrix, note = _of_modes(matrix, recorded.modes, instrument, basis, recorded.where)
    matrix, size_note = _scale_matrix(matrix, instrument, basis)
    return MeasuredMatrix(
        matrix=matrix, sha256=recorded.sha256, notes=tuple(filter(None, (*notes, note, size_note)))
    )


def read_fitted_registration(instrument: str) -> Misregistration | None:
    """Return the registration that a twin's fit has found; None if it was refused, or is no twin.

    The rest of the turbulence would otherwise be that of a mirror elsewhere: with AO188's twin, 40
    deg from nominal, it aliased into 1000 nm of tip and tilt, and alarms accused the mirror.
    """
    path = Path(instrument) / TWIN_FIT
    fit = read_fit(path) if path.is_file() else None
    return fit.alpha if fit is not None and fit.accepted else None


def _check(matrix: Array, instrument: Instrument, where: str) -> None:
    n_slopes = instrument.slopes.kind.n_planes * int(rtc_valid_subapertures(instrument).sum())
    if len(matrix) != n_slopes:
        turned = " (it looks transposed)" if matrix.shape[1] == n_slopes else ""
        raise ConfigurationError(
            f"--matrix: {where}: found {len(matrix)} slopes{turned}, expected {n_slopes}: "
            f"{instrument.slopes.kind.n_planes} of each subaperture of wfs.valid_subapertures"
        )
    wrong = np.argwhere(~np.isfinite(matrix))
    if len(wrong):
        row, column = wrong[0]
        raise ConfigurationError(
            f"--matrix: {where}: found {matrix[row, column]} at slope {row}, column {column} "
            f"({len(wrong)} such numbers in all), expected finite numbers"
        )
    if not matrix.any():
        raise ConfigurationError(f"--matrix: {where}: found zeros only, expected a response")


def _of_modes(
    matrix: Array,
    modes: NDArray[np.intp] | None,
    instrument: Instrument,
    basis: Basis,
    where: str,
) -> tuple[Array, str]:
    """Return a matrix with one column for each mode of the basis, and what was done for it."""
    n_columns, n_modes = matrix.shape[1], basis.n_modes
    if modes is not None and sorted(modes) == list(range(n_modes)):
        return matrix[:, np.argsort(modes)], ""
    if n_columns == n_modes:
        note = "" if modes is None else f"its {n_modes} columns are taken for modes 0, 1, 2, ..."
        return matrix, note
    strokes = basis.mode_to_actuator if isinstance(basis, ModalBasis) else None
    if strokes is not None and modes is None and n_columns == len(strokes):
        return matrix @ strokes, (
            f"{n_columns} columns of actuators are combined into {n_modes} modes by their strokes"
        )
    of_actuators = "" if strokes is None else f", or {len(strokes)} of all actuators"
    raise ConfigurationError(
        f"--matrix: {where}: found {n_columns} columns, expected {n_modes}, one for each mode of "
        f"{instrument.name}{of_actuators}; the instrument file of a rehearsal has the measured "
        "modes alone (modes.n_modes, or the columns of mirror.mode_to_actuator)"
    )


def _scale_matrix(matrix: Array, instrument: Instrument, basis: Basis) -> tuple[Array, str]:
    """Return the matrix in slopes per metre, and how its size compares with the model's."""
    model = InteractionModel(instrument, basis).interaction_matrix(instrument.start)
    sizes = np.linalg.norm(matrix, axis=0)
    answered = sizes > 0.0
    ratio = float(np.median(np.linalg.norm(model, axis=0)[answered] / sizes[answered]))
    if not instrument.mirror.stroke_known:
        return matrix * ratio, (
            f"strokes are unknown: every column is multiplied by {ratio:.4g}, so that the median "
            "mode is as strong as in the model"
        )
    if 1.0 / _PLAUSIBLE_SIZE < ratio < _PLAUSIBLE_SIZE:
        return matrix, ""
    return matrix, (
        f"the median mode is {1.0 / ratio:.3g} times as strong as in the model: is the matrix in "
        'slope per metre of OPD? mirror.stroke = "unknown" takes its size from the model'
    )


class MeasuredPlant(Plant):
    """A measured interaction matrix, with the model of its instrument for what it leaves open."""

    def __init__(
        self,
        instrument: Instrument,
        basis: Basis,
        measured: MeasuredMatrix,
        *,
        start: Misregistration,
        passes: int = 1,
        sky_diameter_m: float | None = None,
        imperfections: Imperfections | None = None,
    ) -> None:
        """Take the registration at which the matrix was measured, as far as anybody knows it.

        ``passes`` says how often the light meets the mirror in the scene. ``sky_diameter_m`` is the
        diameter of the telescope whose turbulence the pupil sees; None: see ``sky_diameter``.
        """
        imperfections = imperfections or SETS["ideal"]
        self._instrument = instrument = replace(instrument, frames=None)
        self._basis, self._passes = basis, np.float32(passes)
        self.measured = measured
        """The matrix, and what was decided about its file."""
        sampling = choose_sampling(instrument)
        self._pupil = instrument_pupil(instrument, sampling)
        self._points = self._pupil.points
        width_m = (
            (sky_diameter_m or sky_diameter(instrument))
            / instrument.diameter_m
            * instrument.subaperture_m
        )
        self.points_m = self._points * width_m
        self.pitch_m = width_m / self._pupil.sampling
        self.weights = self._pupil.weights
        self.valid = valid_subapertures(instrument)
        self.pixels = kind_of(instrument).pixels(instrument, self.valid)
        self.slope_errors = SlopeErrors(
            self.pixels, SETS["ideal"], np.random.default_rng(0), instrument.slopes
        )
        self.sensor_opd_m = np.zeros(len(self._points), dtype=np.float32)
        self._sensor = kind_of(instrument).sensor(instrument, self._pupil, Fineness())
        self._gain = optical_gain(basis.n_modes, imperfections)
        self._beyond_model: Array32 = self._matrix - self._model_matrices(start)[1]

    @property
    def knows_orientation(self) -> bool:
        """Return True if the instrument file states the RTC's slope order."""
        return self._instrument.slopes.orientation is not None

    @property
    def _matrix(self) -> Array32:
        return self.measured.matrix.astype(np.float32)

    @override
    def sort_rows(self, rows: NDArray[Any]) -> NDArray[Any]:
        recipe = self._instrument.slopes
        return to_rtc(rows, recipe, rtc_mask(self.valid, recipe.assumed_orientation))

    @override
    def optics(self, alpha: Misregistration) -> LinearOptics:
        modes = self._render(alpha)
        content = _content(modes, self.weights)
        response = self._sensor.at(self._image_shift(alpha))
        if self.knows_orientation:
            jacobian, model = self._model_matrices(alpha)
            matrix: Array32 = model + self._beyond_model
            jacobian += (matrix * self._gain - model) @ content
        else:
            matrix = self._matrix
            jacobian = np.asarray((matrix * self._gain) @ content, dtype=np.float32)
        return LinearOptics(
            alpha=alpha,
            responses=((1.0, PhaseResponse(jacobian)),),
            slopes_per_command=np.asfortranarray(matrix * (self._gain * self._passes)),
            opd_per_command=modes * self._passes,
            images=response.light / float(response.light.sum()),
            stuck_opd_m=np.zeros(len(modes), dtype=np.float32),
        )

    def _model_matrices(self, alpha: Misregistration) -> tuple[Array32, Array32]:
        """Return K ``(n_slopes, n_points)`` and the model's D, rows as the RTC lists its slopes."""
        jacobian = self._sensor.at(self._image_shift(alpha)).jacobian()
        rows = self.sort_rows(np.asarray(jacobian, dtype=np.float32))
        return rows, rows @ self._render(alpha)

    def _render(self, alpha: Misregistration) -> Array32:
        """Return the modes' shapes ``(n_points, n_modes)``, metres per metre of command."""
        shapes = self._basis.render(self._on_mirror(alpha))
        return np.ascontiguousarray(shapes, dtype=np.float32)


def sky_diameter(instrument: Instrument) -> float:
    """Return the diameter of the telescope whose turbulence and light a pupil gets, metres.

    It is the pupil's own, or ``TELESCOPE_M`` where that is a bench's.
    """
    return instrument.diameter_m if instrument.diameter_m >= BENCH_M else TELESCOPE_M


def _content(modes: Array32, weights: Array) -> Array32:
    """Return ``(n_modes, n_points)``: how much of each mode is in a phase without piston.

    A least-squares fit by area; combinations of modes that have no shape of their own, as piston
    of a basis of actuators, get nothing.
    """
    shapes = modes - (weights @ modes).astype(np.float32)
    weighted = shapes * weights[:, None].astype(np.float32)
    gram = (shapes.T @ weighted).astype(np.float64)
    inverse = scipy.linalg.pinvh(gram, rtol=_WEAKEST_SHAPE)
    return np.asarray(inverse @ weighted.T, dtype=np.float32)
