"""Records of jobs: settings, conditions, answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.control.loop import ControlLoop
from service.control.reconstructor import MAX_CONDITION, InversionMethod
from service.errors import ModelError
from service.estimation.description import Actuators
from service.model.arrays import Arrays, arrays_of
from service.model.instrument import Instrument, Mirror
from service.model.interaction import RtcInteractionModel
from service.model.kinds import ArrayLibrary, Influence
from service.model.memory import GB, work_of
from service.model.misregistration import Determination
from service.model.modes import ModalBasis
from service.model.pupil import instrument_pupil
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from service.records.products import GateVerdict

_Job = TypeVar("_Job", bound=Callable[..., Any])


def waits(at_most_s: float) -> Callable[[_Job], _Job]:
    """Return a decorator for jobs of the worker that may wait for later requests.

    All others are executed first. A job that has waited for this time is executed before anything
    new, so that it does not wait for ever.
    """

    def marked(job: _Job) -> _Job:
        job.patience_s = at_most_s  # type: ignore[attr-defined]
        return job

    return marked


def patience_s(job: Callable[..., Any]) -> float:
    """Return the time for which a job may wait for later requests."""
    return getattr(job, "patience_s", 0.0)


class Sampling(NamedTuple):
    """Sampling of the optics, and its working point."""

    pupil: int = 3
    """Points of the pupil along a subaperture."""

    detector: int = 3
    """Quadrature nodes per detector pixel and axis."""

    working_point_modes: int | None = None
    """Telemetry is compared with the response of a loop that controls this many modes at the
    instrument's r0; None: with that of a flat wavefront."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compute:
    """Limits and options of the worker."""

    threads: int = 2
    """Threads that share the rows of a product; BLAS itself keeps to one."""

    cluster: str | None = None
    """Address of a Dask scheduler whose workers help with rows; None if there is none."""

    array: ArrayLibrary = ArrayLibrary.NUMPY
    """Array library for rows of D."""

    nice: int = 10
    memory_gb: float = 6.0
    """Memory for modes, D and its derivatives; a quarter of it for a sensor's cache."""

    sampling: Sampling = field(default_factory=Sampling)

    method: InversionMethod = InversionMethod.SVD
    """Method by which interaction matrices are inverted."""

    max_condition: float = MAX_CONDITION
    """Largest condition number of a truncated SVD."""

    slope_noise: float = 0.05
    """1 σ of one slope in one frame: of a MAP inversion, and of a star of unknown magnitude. Of a
    pixel it is half."""

    wind_m_s: float = 15.0
    """At which the expected loss of a reconstructor is computed."""

    anamorphosis: bool = False
    """True if dithered windows also measure the anamorphosis."""

    cache: Path | None = None
    """Folder of what is prepared once; None: it is computed every time."""

    @property
    def arrays(self) -> Arrays:
        """The library that computes rows of D.

        Raises
        ------
        ModelError
            If it is not there.
        """
        return arrays_of(self.array)

    @property
    def kept_bytes(self) -> float:
        """Return the memory of a sensor's cache; the worker has up to four."""
        return self.memory_gb * GB / 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MadeReferences:
    """An offset of reference slopes, and what it holds."""

    offset: NDArray[np.float32]
    """``(n_slopes,)`` to be subtracted beyond the RTC's own references."""

    coefficients_m: tuple[float, ...]
    """Coefficients of the modes from mode 0 on with all but 0.1 % of the shape's power, metres."""

    unexplained: float
    """Share of the shape that no controlled mode explains, in norm."""

    refusal: str
    """Reason why they must not be sent; empty if they may."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conditions(Determination):
    """Conditions a reconstructor must hold in.

    The covariance includes the model's error; it is ``(6, 6)`` where an anamorphosis is followed.
    """

    loop: ControlLoop
    """Loop as the gate evaluates it."""

    bound: float
    """Largest pole radius that is accepted."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Made:
    """A reconstructor and the gate's verdict on it."""

    matrix: NDArray[np.float32]
    """``(n_modes, n_slopes)`` metres per slope."""

    condition_number: float
    gate: GateVerdict
    why_fewer: str = ""
    """Reason of the gate against more modes, if it has fewer than requested."""


def actuators_of(model: RtcInteractionModel) -> Actuators | None:
    """Return the mirror's actuators; None where the modes are measured surfaces."""
    basis, mirror = model.basis, model.instrument.mirror
    if not isinstance(basis, ModalBasis) or not isinstance(mirror, Mirror):
        return None
    return Actuators(positions=mirror.positions_m, strokes=basis.mode_to_actuator)


def outer_of(model: RtcInteractionModel) -> NDArray[np.float64] | None:
    """Return the outermost ring as a ``ControlLoop`` has it; None: no metres, or it cannot slip."""
    actuators, mirror = actuators_of(model), model.instrument.mirror
    can_slip = kind_of(model.instrument).edge_slips
    if actuators is None or not isinstance(mirror, Mirror) or not can_slip:
        return None
    if mirror.shape.influence is not Influence.THIN_PLATE or not mirror.stroke_known:
        return None
    return actuators.strokes[actuators.outer]


def check_controllable(instrument: Instrument, compute: Compute) -> None:
    """Refuse what can be fitted offline, but not controlled with, and what does not fit in memory.

    Raises
    ------
    ModelError
        If the stroke is unknown, the RTC delivers frames, or D is too large.
    """
    if not instrument.mirror.stroke_known:
        raise ModelError(
            f"{instrument.name}: found mirror.stroke = unknown; expected a known one (--unit of "
            "pyrcal import): a reconstructor gives metres (pyrcal fit needs none)"
        )
    if instrument.frames is not None:
        raise ModelError(
            f"{instrument.name}: found wfs.input = frames; expected slopes, which is what an RTC "
            "sends (pyrcal fit takes frames)"
        )
    _check_memory(instrument, compute)


def _check_memory(instrument: Instrument, compute: Compute) -> None:
    """Refuse what would not fit, before any of it is taken."""
    sampling, nodes, _ = compute.sampling
    pupil = instrument_pupil(instrument, sampling * instrument.binning)
    fineness = Fineness(n_nodes=nodes * instrument.binning, kept_bytes=compute.kept_bytes)
    sensor = kind_of(instrument).sensor(instrument, pupil, fineness)
    needed = work_of(instrument, sensor, pupil)
    if needed.memory_bytes > compute.memory_gb * GB:
        raise ModelError(
            f"{instrument.name}: found {sensor.n_signals} slopes and {instrument.modes.n_modes} "
            f"modes, whose D and derivatives take {needed.memory_bytes / GB:.1f} GB and "
            f"{needed.flop / 1e12:.2g} TFLOP; expected at most compute.memory_gb = "
            f"{compute.memory_gb:g}: allow more, or ask for fewer modes or a coarser pupil_sampling"
        )


def largest_passing(n_modes: int, fewer: tuple[int, ...], judged: Callable[[int], Made]) -> Made:
    """Return what passes with most modes: fewer are never less stable, so halves are enough."""
    asked = judged(n_modes)
    if asked.gate.accepted:
        return asked
    found, refused, first, end = None, asked, 0, len(fewer)
    while first < end:
        middle = (first + end) // 2
        tried = judged(fewer[middle])
        if tried.gate.accepted:
            found, end = tried, middle
        else:
            refused, first = tried, middle + 1
    if found is None:
        return asked
    return replace(found, why_fewer=f"{len(refused.matrix)} modes: {refused.gate.reason}")
