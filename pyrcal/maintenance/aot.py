"""Export telemetry, matrices and α in the AOT FITS standard.

The standard is Gomes et al. 2024 (doi:10.1051/0004-6361/202348486), written by ``aotpy``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.aot import import_aotpy
from pyrcal.importers.registration import Aot, Dated
from service.errors import ConfigurationError, WireError
from service.files.recording import RecordedKind, Recording
from service.model.instrument import Instrument, Mirror
from service.model.misregistration import Misregistration
from service.model.pupil import rtc_valid_subapertures, valid_subapertures
from service.model.sensors.registry import kind_of
from service.model.slopes import to_conventions
from service.tracking.policy import SECOND_NS
from service.wire import FrameBatch, Manifest, Status, decode, decode_frames

FRAMES = "frames"
"""Name of the time of all measurements, by which files written by pyrcal are recognised."""


@dataclass(slots=True, kw_only=True)
class Excerpt:
    """Some seconds of a recording."""

    batches: list[FrameBatch] = field(default_factory=list)
    status: Status | None = None
    """Last status of the excerpt, or before it; None if there is none."""

    matrices: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    """Reconstructors ``(n_modes, n_slopes)`` in the RTC's order, by id."""

    n_damaged: int = 0
    """Number of messages that break the contract and are left out."""

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return sum(batch.header.n for batch in self.batches)

    @property
    def first_ns_utc(self) -> int:
        """End of the first frame, by the RTC's clock."""
        return self.batches[0].header.t0_ns

    @property
    def last_ns_utc(self) -> int:
        """End of the last frame."""
        header = self.batches[-1].header
        return header.t0_ns + (header.n - 1) * header.dt_ns


def excerpt(path: Path, first_s: float, seconds: float) -> Excerpt:
    """Return some seconds of a recording.

    Parameters
    ----------
    path
        As ``service.files.recording`` has it.
    first_s
        Seconds since its beginning.
    seconds
        How much of it.

    Raises
    ------
    ConfigurationError
        If it cannot be read, or has no frames of this time.
    """
    found = Excerpt()
    with Recording(path) as recording:
        for message in recording.messages():
            if message.time_s > first_s + seconds:
                break
            # Status and matrices from before the excerpt are kept: they hold during it.
            try:
                if message.kind is RecordedKind.STATUS:
                    found.status = decode(Status, message.payload)
                elif message.kind is RecordedKind.MATRIX:
                    manifest = decode(Manifest, message.attachment)
                    numbers = np.frombuffer(message.payload, "<f4")
                    found.matrices[manifest.id] = numbers.reshape(manifest.layout.shape)
                elif message.kind is RecordedKind.FRAMES and message.time_s >= first_s:
                    found.batches.append(decode_frames(message.payload, message.attachment))
            except (WireError, ValueError):
                found.n_damaged += 1
    if not found.batches:
        raise ConfigurationError(
            f"{path}: found no frames from {first_s:g} s on for {seconds:g} s, expected some"
        )
    # Another session counts its frames from 0 again: one loop of the standard cannot hold both.
    session = found.batches[0].header.session
    found.batches = [batch for batch in found.batches if batch.header.session == session]
    return found


def write_aot(
    path: Path, instrument: Instrument, estimates: Iterable[Dated], taken: Excerpt | None
) -> None:
    """Write telemetry and α over time as AOT FITS.

    Slopes are in the order, axes and signs of conventions.md, ``(t, 2, n_valid)``, pixels
    ``(t, 4, n_valid)``; modal commands are metres OPD, ``(t, n_modes)``. Each reconstructor in use
    has a loop of its own. α is the ``transformation_matrix`` ``(3, 3, t)`` of the mirror: from
    metres in the pupil, as its actuators are drawn, to metres on the sensor.

    Parameters
    ----------
    path
        Ends in ``.fits``; must not exist.
    instrument
        Of the telemetry.
    estimates
        α over time, oldest first.
    taken
        Telemetry; None: none.

    Raises
    ------
    ConfigurationError
        If ``aotpy`` is not installed, or the file cannot be written.
    ModelError
        If the telemetry is not of this instrument.
    """
    aotpy = import_aotpy()
    if path.exists():
        raise ConfigurationError(f"{path}: exists already; expected a new file")
    system = _system(aotpy, instrument, tuple(estimates))
    if taken is not None:
        _add_telemetry(aotpy, system, instrument, taken)
    try:
        with warnings.catch_warnings():
            # Missing fields stay empty: without telemetry there is no loop to describe
            warnings.filterwarnings("ignore", message=".*contains no data")
            system.write_to_file(path, "fits")
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be written: {error}") from error


def _system(aotpy: Aot, instrument: Instrument, estimates: tuple[Dated, ...]) -> Aot:
    telescope = aotpy.MainTelescope(
        uid="telescope",
        enclosing_diameter=instrument.diameter_m,
        obstruction_diameter=instrument.obscuration_ratio * instrument.diameter_m,
    )
    source = aotpy.NaturalGuideStar(uid="source")
    valid = valid_subapertures(instrument)
    # The standard's mask lists each subaperture's place among the slopes, -1 where there is none.
    places = np.full(valid.shape, -1, dtype=np.int32)
    places[valid] = np.arange(valid.sum())
    aot_class, own = kind_of(instrument).aot(instrument.slopes)
    sensor = getattr(aotpy, aot_class)(
        **own,
        uid="sensor",
        source=source,
        n_valid_subapertures=int(valid.sum()),
        subaperture_mask=aotpy.Image("subaperture mask", places),
        wavelength=instrument.wfs.wavelength_m,
    )
    corrector = aotpy.DeformableMirror(
        uid="mirror",
        telescope=telescope,
        n_valid_actuators=1,
        transformation_matrix=_over_time(aotpy, instrument, estimates),
    )
    if isinstance(instrument.mirror, Mirror):
        # α acts on positions as they are drawn, with the mirror seen from its front.
        drawn = instrument.mirror.positions_m * [1.0, instrument.mirror.y_sign]
        corrector.n_valid_actuators = len(drawn)
        corrector.actuator_coordinates = [aotpy.Coordinates(x, y) for x, y in drawn.tolist()]
    return aotpy.AOSystem(
        ao_mode="SCAO",
        name=instrument.name,
        main_telescope=telescope,
        sources=[source],
        wavefront_sensors=[sensor],
        wavefront_correctors=[corrector],
    )


def _over_time(aotpy: Aot, instrument: Instrument, estimates: tuple[Dated, ...]) -> Aot:
    """Return α over time; None if there is no estimate."""
    if not estimates:
        return None
    seconds = [at.t_ns_utc / SECOND_NS for at in estimates if at.t_ns_utc is not None]
    matrices = [affine(at.alpha, instrument.subaperture_m) for at in estimates]
    time = aotpy.Time(uid="time of registration", timestamps=seconds) if seconds else None
    return aotpy.Image("registration", np.stack(matrices, axis=-1), time=time)


def affine(alpha: Misregistration, subaperture_m: float) -> NDArray[np.float64]:
    """Return ``(3, 3)``, from ``(x, y, 1)`` on the mirror to the sensor, metres in the pupil."""
    matrix = np.eye(3)
    matrix[:2, :2] = alpha.image
    matrix[:2, 2] = alpha.vector[:2] * subaperture_m
    return matrix


def _add_telemetry(aotpy: Aot, system: Aot, instrument: Instrument, taken: Excerpt) -> None:
    headers = [batch.header for batch in taken.batches]
    rows = [np.arange(header.n) for header in headers]
    seqs = np.concatenate([h.seq0 + row for h, row in zip(headers, rows, strict=True)])
    t_ns = np.concatenate([h.t0_ns + row * h.dt_ns for h, row in zip(headers, rows, strict=True)])
    ids = np.concatenate([np.full(h.n, h.cm_id or "unknown", dtype=object) for h in headers])
    commands_m = np.concatenate([batch.commands_m for batch in taken.batches])
    slopes = _as_listed(np.concatenate([batch.slopes for batch in taken.batches]), instrument)
    (sensor,), (corrector,) = system.wavefront_sensors, system.wavefront_correctors
    sensor.measurements = aotpy.Image("slopes", slopes, time=_time(aotpy, FRAMES, t_ns, seqs))
    system.date_beginning, system.date_end = (
        datetime.fromtimestamp(int(t) / SECOND_NS, UTC).replace(tzinfo=None)
        for t in (t_ns[0], t_ns[-1])
    )
    status = taken.status
    # A loop has one reconstructor in the standard: frames of another one are another loop.
    for cm_id in dict.fromkeys(ids.tolist()):
        those, matrix = ids == cm_id, taken.matrices.get(cm_id)
        time = _time(aotpy, f"frames of {cm_id}", t_ns[those], seqs[those])
        control = None
        if matrix is not None:
            control = aotpy.Image(f"reconstructor {cm_id}", _as_listed(matrix, instrument), "m")
        system.loops.append(
            aotpy.ControlLoop(
                uid=cm_id,
                input_sensor=sensor,
                commanded_corrector=corrector,
                closed=status is None or status.loop == "closed",
                framerate=SECOND_NS / headers[0].dt_ns,
                delay=None if status is None else status.delay_frames,
                time=time,
                modal_coefficients=aotpy.Image(
                    f"commands {cm_id}", commands_m[those], "m", time=time
                ),
                measurements_to_modes=control,
            )
        )


def is_own(measurements: Aot) -> bool:
    """Return True if measurements in an AOT file were written by pyrcal, in its axes."""
    time = measurements.time
    return time is not None and str(time.uid).casefold() == f"time of {FRAMES}"


def _time(aotpy: Aot, name: str, t_ns: NDArray[np.int64], seqs: NDArray[np.int64]) -> Aot:
    seconds = (t_ns / SECOND_NS).tolist()
    return aotpy.Time(uid=f"time of {name}", timestamps=seconds, frame_numbers=seqs.tolist())


def _as_listed(values: NDArray[np.float32], instrument: Instrument) -> NDArray[np.float32]:
    """Return the RTC's signals ``(n, n_slopes)`` in pyrcal's order: ``(n, 2, n_valid)``, or 4."""
    recipe = instrument.slopes
    mask = rtc_valid_subapertures(instrument)
    ours = to_conventions(values.T, recipe, mask)
    return np.ascontiguousarray(ours.T).reshape(len(values), recipe.kind.n_planes, -1)
