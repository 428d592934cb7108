"""Policies derived from settings: tracker, model error, worker, retention."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray

from service.config.settings import OffloadTable, Settings
from service.control.reconstructor import InversionMethod
from service.files.disk_cache import usual_folder
from service.model.instrument import Instrument, TabulatedModes
from service.model.misregistration import BOUNDARY_SCALE
from service.model.sensors.registry import kind_of
from service.records.alarms import Interlock, Severity
from service.runtime.worker import Compute, Sampling
from service.tracking.policy import Offloading, Policy, Rule, SensorModePolicy

FLAT = (0.004, 0.01, 0.001)
"""Shift in subapertures, rotation in degrees, magnification: floor of the model error if the
telemetry of a working pyramid is compared with the response to a flat wavefront. The misfit of
windows is added."""

AT_WORK = (0.001, 0.005, 0.0005)
"""The same where it is compared with the response at the working point."""


REFERENCE_MODES, REFERENCE_SUBAPERTURES = 500, 30
"""Modes and subapertures of the telescope for which ``USELESS`` and ``STALE`` were chosen: FLAO."""

USELESS = np.array([0.1, 0.1, 0.3, 0.01])
"""1 σ of shifts in subapertures, rotation in degrees and magnification beyond which α is not used:
the misregistration that 594 modes of FLAO tolerate without loss, three times that in rotation."""

STALE = np.array([0.05, 0.1, 0.003])
"""1 σ of a shift in subapertures, of rotation in degrees and of magnification from which on α is
stale: half of what 594 modes of FLAO tolerate."""

UPDATE = np.array([0.08, 0.08, 0.005])
"""Change of a shift in subapertures, of rotation in degrees and of magnification that makes a new
reconstructor whatever it wins: about what 594 modes of FLAO tolerate."""

MEASURED_PITCH = 0.30 / 8.22
"""Distance between actuators over the pupil's diameter where these floors were measured: FLAO."""


def floor_of(settings: Settings, instrument: Instrument | None = None) -> NDArray[np.float64]:
    """Return the model-error floor ``(4,)`` in boundary units: subapertures, degrees, ratio.

    What the settings leave open is what campaigns on the diffractive telescope found
    (docs/results/tracking.md). Influence functions are wrong by a share of their width: of a mirror
    of few actuators, rotation and magnification are as much more uncertain as it is coarser.
    """
    tracking = settings.tracking
    flat = settings.compute.working_point_modes is None
    shift, rotation, magnification = FLAT if flat else AT_WORK
    coarser = _coarser(instrument)
    rotation, magnification = rotation * coarser, magnification * coarser
    given = (tracking.floor_shift_subap, tracking.floor_rotation_deg, tracking.floor_magnification)
    shift, rotation, magnification = (
        found if asked is None else asked
        for found, asked in zip((shift, rotation, magnification), given, strict=True)
    )
    floor = np.array([shift, shift, rotation, magnification])
    if instrument is None:
        return floor
    # places of the pupil images that the file calls unknown displace every estimate alike
    unknown, _ = kind_of(instrument).image_floors(instrument)
    return np.asarray(np.hypot(floor, unknown * BOUNDARY_SCALE))


def _coarser(instrument: Instrument | None) -> float:
    """Return how much coarser an analytic mirror is than FLAO's; of others nothing is known."""
    if instrument is None or isinstance(instrument.mirror, TabulatedModes):
        return 1.0
    return max(1.0, instrument.mirror.pitch_m / instrument.diameter_m / MEASURED_PITCH)


def policy_of(settings: Settings, instrument: Instrument | None = None) -> Policy:
    """Return the policy in numeric units: radians, rates per square root of a second.

    ``instrument`` provides the sensor modes, the pointing law and the pitch of the mirror; without
    it there are no modes and no law, and the mirror is like FLAO's.
    """
    dither, tracking, control = settings.dither, settings.tracking, settings.control
    unknown = unstated = np.zeros(4)
    if instrument is not None:
        unknown, unstated = kind_of(instrument).image_floors(instrument)
    per_minute = _vector(
        tracking.drift_subap_per_minute,
        tracking.drift_deg_per_minute,
        tracking.drift_magnification_per_minute,
    )
    return Policy(
        dither_enabled=dither.enabled,
        dither_amplitude_m=dither.amplitude_m,
        dither_budget_m=dither.budget_m,
        dither_sigma=_vector(
            dither.sigma_shift_subap, dither.sigma_rotation_deg, dither.sigma_magnification
        ),
        dither_avoid_hz=dither.avoid_hz,
        longest_pause_s=dither.longest_pause_s,
        dither_modes=dither.modes,
        dither_frequencies_hz=dither.frequencies_hz,
        window_s=dither.window_s,
        longest_window_s=dither.longest_window_s,
        # A random walk: its σ grows with the square root of time.
        drift_rate=per_minute / np.sqrt(60.0),
        floor=floor_of(settings, instrument) / BOUNDARY_SCALE,
        image_floor=unstated,
        image_sigma=unknown + unstated,
        bias_memory_s=tracking.bias_memory_s,
        flexure_per_degree=_vector(
            tracking.flexure_subap_per_degree,
            tracking.flexure_deg_per_degree,
            tracking.flexure_magnification_per_degree,
        ),
        slew_limit_deg=tracking.slew_limit_deg,
        stale_sigma=_limits(
            (tracking.stale_shift_subap, tracking.stale_rotation_deg, tracking.stale_magnification),
            STALE * tolerance_scale(settings, instrument)[1:],
        ),
        useless_sigma=USELESS / BOUNDARY_SCALE * tolerance_scale(settings, instrument),
        tolerance=tolerance_scale(settings, instrument),
        acquires=settings.acquisition.auto,
        acquisition_amplitude_m=settings.acquisition.amplitude_m,
        n_modes_target=control.n_modes_target,
        update_threshold=_limits(
            (
                control.update_shift_subap,
                control.update_rotation_deg,
                control.update_magnification,
            ),
            UPDATE * tolerance_scale(settings, instrument)[1:],
        ),
        update_gain_m=control.update_gain_nm * 1e-9,
        update_margin=control.update_margin,
        minimum_interval_s=control.minimum_interval_s,
        worst_seeing_arcsec=settings.references.worst_seeing_arcsec,
        references_ramp_s=settings.references.ramp_s,
        opens_lost_loop=control.open_lost_loop,
        rules=tuple(
            Rule(
                name=rule.name,
                about=rule.when[0],
                how=rule.when[1],
                than=rule.when[2],
                blocks=frozenset(Interlock(act) for act in rule.blocks),
                severity=Severity(rule.severity),
                text=rule.text,
                holds_unknown=rule.unknown == "holds",
            )
            for rule in settings.rules
        ),
        offloading=_convert_offloading(settings.offload),
        sensor_modes={} if instrument is None else _sensor_modes(instrument),
        law=None if instrument is None else instrument.law,
    )


def tolerance_scale(
    settings: Settings, instrument: Instrument | None = None
) -> NDArray[np.float64]:
    """Return ``(4,)`` how much more misregistration a loop tolerates than that of the reference.

    The tolerance depends on the controlled modes (Heritier et al. 2018, section 3.2). Here it is a
    fixed share of the width of the finest controlled mode, which is ``N sqrt(pi / (4 n))``
    subapertures for n modes on N subapertures. A shift displaces the image as a whole, rotation and
    magnification displace its rim by N / 2 times the parameter. Never below 1: what is allowed for
    the reference was safe on every telescope tried.
    """
    if instrument is None:
        return np.ones(4)
    n_modes = settings.control.n_modes_target
    if not isinstance(instrument.mirror, TabulatedModes):
        n_modes = min(n_modes, instrument.modes.n_modes)
    finer = float(np.sqrt(REFERENCE_MODES / n_modes))
    shift = finer * instrument.wfs.n_subapertures / REFERENCE_SUBAPERTURES
    return np.maximum([shift, shift, finer, finer], 1.0)


def _limits(
    given: tuple[float | None, float | None, float | None], usual: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return limits ``(4,)`` in numeric units: as they are set, else the usual ones."""
    shift, rotation, magnification = (
        float(default if value is None else value)
        for value, default in zip(given, usual, strict=True)
    )
    return _vector(shift, rotation, magnification)


def _sensor_modes(instrument: Instrument) -> dict[str, SensorModePolicy]:
    """Return what the tracker must know of the modes of a sensor, by their ``config_id``."""
    return {
        mode.config_id: SensorModePolicy(
            subaperture_m=mode.of(instrument).subaperture_m,
            n_controlled=mode.loop.n_controlled,
        )
        for mode in instrument.sensor_modes
    }


def _convert_offloading(table: OffloadTable) -> Offloading | None:
    if not table.enabled:
        return None
    return Offloading(
        share=table.gain,
        near=np.array(table.dead_band) / BOUNDARY_SCALE,
        max_step=np.array(table.most_step) / BOUNDARY_SCALE,
        travel=np.array(table.reach) / BOUNDARY_SCALE,
        settle_s=table.settle_s,
    )


def _vector(shift_subap: float, rotation_deg: float, magnification: float) -> NDArray[np.float64]:
    """Return ``(4,)`` in numeric units: the same for both shifts."""
    return np.array([shift_subap, shift_subap, np.deg2rad(rotation_deg), magnification])


def compute_of(settings: Settings) -> Compute:
    """Return what the worker may use and how finely it samples the optics."""
    table = settings.compute
    return Compute(
        threads=table.threads,
        cluster=table.cluster,
        array=table.array,
        nice=table.nice,
        memory_gb=table.memory_gb,
        sampling=Sampling(table.pupil_sampling, table.detector_nodes, table.working_point_modes),
        method=InversionMethod(settings.control.method),
        max_condition=settings.control.max_condition,
        slope_noise=settings.control.slope_noise,
        wind_m_s=settings.control.wind_m_s,
        anamorphosis=settings.tracking.anamorphosis,
        cache=settings.service.cache_dir or usual_folder(os.environ),
    )
