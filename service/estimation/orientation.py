"""Find axes and signs of slopes, and a rough rotation, from the lowest modes.

The RTC's order of rows and columns, its sign of light and the mirror's rotation all appear in tip,
tilt and the few shapes after them. The gains of all shapes share one sign here. With a free sign
for each, four orientations explain any matrix equally well, and tip and tilt alone leave two that
differ by half a turn.

Rotating the mirror by 90 deg and the axes of the slopes back cannot be detected by any measurement.
Among such equivalent orientations the nominal rotation of the mirror decides if it is known;
otherwise the orientation with the fewest flips, and among those the smallest rotation.

The smoothest shapes that a set of modes can form are correct from far away. The lowest
Karhunen-Loeve modes are such shapes; a user's own modes, or single actuators, are combined to form
them. The combination is the same for the model and for the measured columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from service.errors import ModelError
from service.estimation.reference import Reference, Target, target_of
from service.estimation.solver import vertex
from service.model.defects import list_ranges
from service.model.instrument import Instrument
from service.model.interaction import InteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration, rotation, wrap_angle
from service.model.modes import Basis
from service.model.pupil import rtc_valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Mapper, by_rows
from service.model.slopes import FLIPS, Orientation, SlopeRecipe, orient_mask

Array = NDArray[np.float64]

ANGLES_RAD = np.deg2rad(np.arange(0.0, 360.0, 6.0))
"""Rotations tried; shapes of degree 5 have lost a tenth half-way between two of them."""

_POINTS_TOGETHER = 4096
"""Pupil points whose shapes are evaluated at once: with fewer, tiles of thin plates would be split.
"""

NOMINAL = Misregistration()

MIN_CORRELATION_LEAD = 0.08
"""Smallest difference of the correlations by which two classes of orientations are distinguished.
"""

MIN_CORRELATION = 0.4
"""Below, no orientation explains the lowest orders."""


DOUBTFUL_CORRELATION = 0.8
"""Below, others than a stated orientation are looked at as well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """One orientation of the slopes with the rotation at which it explains them best."""

    slopes: SlopeRecipe
    rotation_rad: float
    correlation: float
    """Mean correlation of the lowest orders with the model, one sign for all, -1..1."""

    @property
    def turned_class(self) -> tuple[SlopeOrder, int, int, bool]:
        """The class of poses that differ by quarter turns of everything."""
        axes = self.slopes.assumed_orientation
        return self.slopes.order, axes.sign_x, axes.sign_y, self.is_mirrored

    @property
    def is_mirrored(self) -> bool:
        """Return True if the grid of the slopes is mirrored."""
        return self.n_changes % 2 == 1

    @property
    def n_changes(self) -> int:
        """Flips and swaps of the axes."""
        return sum(getattr(self.slopes.assumed_orientation, name) for name in FLIPS)

    @property
    def effort(self) -> tuple[int, float]:
        """Changes of the axes, then turn of the mirror: the least is the likeliest."""
        return self.n_changes, abs(self.rotation_rad)

    def describe_orientation(self) -> str:
        """Return it in the words of the instrument file."""
        return f"{format_setting(self.slopes)} at {np.rad2deg(self.rotation_rad):.0f} deg"


def format_setting(slopes: SlopeRecipe) -> str:
    """Return order and orientation of slopes in the notation of the instrument file."""
    axes = slopes.assumed_orientation
    flags = [f"{name} = true" for name in FLIPS if getattr(axes, name)]
    words = ", ".join([*flags, format_sign(axes)])
    return f'order = "{slopes.order}", orientation = {{ {words} }}'


def format_sign(axes: Orientation) -> str:
    """Return the signs of an orientation in the notation of the instrument file."""
    if axes.sign_x == axes.sign_y:
        return f"sign = {axes.sign_x}"
    return f"sign = [{axes.sign_x}, {axes.sign_y}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """Result of the search over orientations."""

    best: Pose
    ties: tuple[Pose, ...]
    """Others that explain them as well; empty: it is unique."""

    lowest: LowOrder
    """Smooth combinations of the modes that were compared."""

    @property
    def refusal(self) -> str:
        """Why no orientation is clear; empty: one is."""
        if self.best.correlation < MIN_CORRELATION:
            return (
                f"no orientation of the slopes explains the lowest orders (correlation "
                f"{self.best.correlation:.2f}): the modes are another basis or "
                "in another order, or the matrix another instrument's"
            )
        if self.ties:
            named = "; ".join(pose.describe_orientation() for pose in (self.best, *self.ties))
            return (
                f"the orientation is ambiguous: {named} explain the lowest orders equally well; "
                "state [slopes] orientation, or measure more of the low modes"
            )
        return ""


def check_stated_orientation(stated: Pose, found: Pose) -> str:
    """Return why a stated orientation cannot be the RTC's; empty: it may be."""
    if found.correlation < stated.correlation + 2.0 * MIN_CORRELATION_LEAD:
        return ""
    text = (
        f"with {format_setting(stated.slopes)} the lowest orders correlate with the model by "
        f"{stated.correlation:.2f}, with {found.describe_orientation()} by {found.correlation:.2f}"
    )
    if found.is_mirrored is not stated.is_mirrored:
        return (
            f"{text}: the slopes' grid is mirrored, or the actuators' coordinates are (parity = "
            "-1) or are exchanged"
        )
    return f"{text}: correct [slopes]"


def find_orientation(
    instrument: Instrument,
    reference: Reference,
    basis: Basis,
    *,
    mapper: Mapper = map,
    about: Misregistration = NOMINAL,
    coarse: CoarseModel | None = None,
) -> Search:
    """Return the orientation and rough rotation that explain the lowest orders best.

    ``basis`` holds the columns of ``reference``. Shift and magnification are those of ``about``:
    the lowest orders hardly feel less than a subaperture. ``coarse`` is ``coarse_model`` of
    instrument and basis for several searches; None to make it.
    """
    stated = instrument.slopes
    settings = [stated] if stated.orientation is not None else list(_settings(stated))
    coarse = coarse or coarse_model(instrument, basis, mapper)
    poses, lowest = poses_of(coarse, instrument, reference, settings, mapper=mapper, about=about)
    return _judge_classes(poses, instrument.mirror.nominal_rotation_rad, lowest)


def poses_of(
    coarse: CoarseModel,
    instrument: Instrument,
    reference: Reference,
    settings: Sequence[SlopeRecipe],
    *,
    mapper: Mapper = map,
    about: Misregistration = NOMINAL,
) -> tuple[list[Pose], LowOrder]:
    """Return how well each of these orders and orientations explains the lowest orders."""
    turned = _Turned.of(coarse, mapper, about)
    low = replace(
        reference,
        matrix=turned.lowest.combine_columns(reference.matrix),
        modes=None,
        noise=None,
    )
    poses = [
        turned.pose(target_of(low, replace(instrument, slopes=slopes)), slopes)
        for slopes in settings
    ]
    return poses, turned.lowest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CoarseModel:
    """A coarse model of every subaperture that some orientation calls valid."""

    model: InteractionModel
    lowest: LowOrder
    """Smooth combinations of the model's modes."""


def coarse_model(instrument: Instrument, basis: Basis, mapper: Mapper = map) -> CoarseModel:
    """Return the coarse model of an instrument, whatever orientation it states."""
    mask = rtc_valid_subapertures(instrument)
    flags = (False, True)
    turned = [
        orient_mask(mask, Orientation(swap_xy=swap, flip_x=flip_x, flip_y=flip_y))
        for swap, flip_x, flip_y in product(flags, flags, flags)
    ]
    every = replace(instrument.wfs, valid_subapertures=np.any(turned, axis=0))
    order = instrument.slopes.kind.orders[0]
    plain = replace(instrument.slopes, order=order, orientation=Orientation())
    seen = replace(instrument, wfs=every, slopes=plain)
    sampling = coarse_sampling(instrument)
    model = InteractionModel(
        seen, basis, pupil_sampling=sampling, detector_nodes=sampling, mapper=mapper
    )
    return CoarseModel(model=model, lowest=low_order_of(model))


def _settings(reported: SlopeRecipe) -> Iterator[SlopeRecipe]:
    """Yield every orientation, and with exchanged components if the order has them."""
    order = reported.order
    plain, exchanged = order.kind.orders[:2]
    others = {plain: [exchanged], exchanged: [plain]}
    yield from settings_of(reported, [order, *others.get(order, [])])


def settings_of(reported: SlopeRecipe, orders: Iterable[SlopeOrder]) -> Iterator[SlopeRecipe]:
    """Yield every orientation and pair of signs in each of these orders."""
    flags = (False, True)
    for listed, swap, flip_x, flip_y, sign_x, sign_y in product(
        orders, flags, flags, flags, (1, -1), (1, -1)
    ):
        axes = Orientation(swap_xy=swap, flip_x=flip_x, flip_y=flip_y, sign_x=sign_x, sign_y=sign_y)
        yield replace(reported, order=listed, orientation=axes)


def _judge_classes(poses: list[Pose], nominal_rad: float | None, lowest: LowOrder) -> Search:
    best = max(pose.correlation for pose in poses)
    near = [pose for pose in poses if pose.correlation > best - MIN_CORRELATION_LEAD]
    leader = max(near, key=lambda pose: pose.correlation)

    def preference(pose: Pose) -> tuple[float, float]:
        if nominal_rad is not None:
            return abs(wrap_angle(pose.rotation_rad - nominal_rad)), pose.n_changes
        return pose.effort

    classes: dict[object, list[Pose]] = {}
    for pose in near:
        classes.setdefault(pose.turned_class, []).append(pose)
    chosen = min(classes.pop(leader.turned_class), key=preference)
    ties = tuple(min(others, key=preference) for others in classes.values())
    return Search(best=chosen, ties=ties, lowest=lowest)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Turned:
    """A coarse model's lowest modes at every rotation."""

    lowest: LowOrder
    columns: Array
    """``(n_low, n_angles, n_slopes)`` the model's answer at each of ``ANGLES_RAD``."""

    valid: NDArray[np.bool_]
    """``(n, n)`` [y, x] subapertures of these slopes."""

    @classmethod
    def of(cls, coarse: CoarseModel, mapper: Mapper, about: Misregistration) -> _Turned:
        """Turn the smoothest shapes of a model's modes round."""
        model, lowest = coarse.model, coarse.lowest
        points = (model.pupil.points - about.vector[:2]) / about.magnification
        angles = ANGLES_RAD[:: _SMOOTH_STEP if lowest.is_smooth else 1]
        turned = np.concatenate([points @ rotation(angle) for angle in angles])
        rendered = by_rows(mapper, lowest.shapes.render, turned, _POINTS_TOGETHER)
        by_point = rendered.reshape(len(angles), len(points), -1).swapaxes(0, 1)
        # one product for all: each by itself would read the whole sensor again
        seen = model.measure_signals(Misregistration(), by_point.reshape(len(points), -1)).reshape(
            model.n_slopes, len(angles), -1
        )
        columns = np.ascontiguousarray(seen.transpose(2, 1, 0), dtype=np.float64)
        if lowest.is_smooth:
            spectrum = np.fft.rfft(columns, axis=1, norm="forward")
            columns = np.fft.irfft(spectrum, n=len(ANGLES_RAD), axis=1, norm="forward")
        return cls(lowest=lowest, columns=columns, valid=model.valid)

    @cached_property
    def _norm(self) -> Array:
        """``(n_low, n_angles)`` norm of every answer."""
        return np.asarray(np.linalg.norm(self.columns, axis=2))

    def pose(self, target: Target, slopes: SlopeRecipe) -> Pose:
        """Return the rotation at which the model explains these columns best."""
        low = target.matrix / np.linalg.norm(target.matrix, axis=0)
        seen = np.tile(target.valid[self.valid], slopes.kind.n_planes)
        columns = self.columns if seen.all() else self.columns[:, :, seen]
        along = np.matmul(columns, low.T[:, :, None])[:, :, 0]
        norm = self._norm if seen.all() else np.linalg.norm(columns, axis=2)
        correlation = (along / norm).mean(axis=0)
        best = int(np.argmax(correlation))
        # The angles go round: the first follows the last.
        before, at, after = np.take(correlation, [best - 1, best, best + 1], mode="wrap")
        step = vertex(before, at, after)
        angle = ANGLES_RAD[best] + step * (ANGLES_RAD[1] - ANGLES_RAD[0])
        return Pose(slopes=slopes, rotation_rad=wrap_angle(float(angle)), correlation=float(at))


POLYNOMIAL_DEGREE = 5
"""Degree of the polynomials that represent the lowest orders: 20 without piston."""

_SMOOTH_STEP = 3
"""Step of the angles at which smooth shapes are computed, and interpolated by their Fourier series
between them: 20 angles determine angular orders below 10, twice those of such polynomials."""

MIN_REPRESENTED_SHARE = 0.5
"""Least share of a smooth shape's amplitude that the modes must be able to make."""

MIN_COMBINATIONS = 3
"""Combinations below which single modes lead, smooth or not."""

MAX_SINGLE_MODES = 20

UNSEEN_RESPONSE_RATIO = 1e-9
"""Response of a mode over the largest, below which it is none."""

_MAX_LISTED_MODES = 5


def coarse_sampling(instrument: Instrument) -> int:
    """Return how many pupil points a subaperture needs for the smoothest shapes."""
    return kind_of(instrument).coarsest_sampling(instrument.wfs)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LowOrder:
    """Smooth combinations of the modes of a basis."""

    shapes: Basis
    """The combinations, as modes of their own."""

    combinations: Array
    """``(n_modes, n_low)`` of measured columns of unit size."""

    is_smooth: bool
    """True if they are close to polynomials; False if they are single modes."""

    def combine_columns(self, matrix: Array) -> Array:
        """Return the combinations ``(n_slopes, n_low)`` of measured columns, in any order of rows.

        Only the columns' shapes count: their unit and gains are taken from the model.
        """
        return np.asarray((matrix / np.linalg.norm(matrix, axis=0)) @ self.combinations)


def low_order_of(model: InteractionModel) -> LowOrder:
    """Return the smooth combinations of a model's modes; the first modes if there are hardly any.

    The model may be coarse. Shapes are compared over that part of the pupil where the surface is
    known, without their mean.

    Raises
    ------
    ModelError
        If the sensor does not see a mode.
    """
    points = model.pupil.points
    root = np.sqrt(model.pupil.weights)[:, None]
    matrix = np.asarray(model.interaction_matrix(Misregistration()), dtype=np.float64)
    response = np.linalg.norm(matrix, axis=0)
    unseen = np.flatnonzero(response <= UNSEEN_RESPONSE_RATIO * response.max())
    if len(unseen):
        raise ModelError(
            f"{model.instrument.name}: found {len(unseen)} of {len(response)} modes that move "
            f"nothing the sensor sees (columns {list_ranges(unseen, _MAX_LISTED_MODES)}); "
            "expected actuators or tables in metres over the pupil (--modes leaves some out)"
        )
    root = np.where(model.basis.known(points)[:, None], root, 0.0)
    modes = model.basis.render(points) / response * root
    modes -= root * (root.T @ modes) / np.sum(root**2)
    smooth = _smooth(points, root)
    gram = modes.T @ modes
    # A ridge, because modes may be nearly dependent: without it their combinations would be large
    # and of opposite signs.
    held = gram + 1e-3 * np.trace(gram) / len(gram) * np.eye(len(gram))
    combined = np.linalg.solve(held, modes.T @ smooth)
    _, size, axes = np.linalg.svd(modes @ combined, full_matrices=False)
    kept = size > MIN_REPRESENTED_SHARE
    combined = combined @ (axes[kept].T / size[kept])
    is_smooth = combined.shape[1] >= MIN_COMBINATIONS
    if not is_smooth:
        combined = np.eye(len(response))[:, :MAX_SINGLE_MODES]
    shapes = model.basis.combine_modes(combined / response[:, None])
    return LowOrder(shapes=shapes, combinations=combined, is_smooth=is_smooth)


def _smooth(points: Array, root: Array) -> Array:
    """Return orthonormal polynomials without piston, times the root of the pupil's weights."""
    x, y = (points / np.abs(points).max()).T
    powers = [x**i * y ** (n - i) for n in range(POLYNOMIAL_DEGREE + 1) for i in range(n + 1)]
    orthonormal, _ = np.linalg.qr(np.column_stack(powers) * root)
    # The first power is the constant, so that the first orthonormal column is piston.
    return np.asarray(orthonormal[:, 1:])
