"""The tracker's policy, from the user's settings."""

from __future__ import annotations

import numpy as np

from service.config.floor import floor_of
from service.config.settings import Settings
from service.model.misregistration import BOUNDARY_SCALE
from service.reactions.policy import Policy


def policy_of(settings: Settings) -> Policy:
    """Return the policy in numeric units: radians, rates per square root of a second."""
    dither, tracking, control = settings.dither, settings.tracking, settings.control
    per_minute = np.array(
        [
            tracking.drift_subap_per_minute,
            tracking.drift_subap_per_minute,
            np.deg2rad(tracking.drift_deg_per_minute),
            tracking.drift_magnification_per_minute,
        ]
    )
    return Policy(
        dither_enabled=dither.enabled,
        dither_amplitude_m=dither.amplitude_m,
        dither_budget_m=dither.budget_m,
        dither_sigma=np.array(
            [
                dither.sigma_shift_subap,
                dither.sigma_shift_subap,
                np.deg2rad(dither.sigma_rotation_deg),
                dither.sigma_magnification,
            ]
        ),
        dither_avoid_hz=dither.avoid_hz,
        longest_pause_s=dither.longest_pause_s,
        dither_modes=dither.modes,
        dither_frequencies_hz=dither.frequencies_hz,
        window_s=dither.window_s,
        longest_window_s=dither.longest_window_s,
        drift_rate=per_minute / np.sqrt(60.0),
        floor=floor_of(settings) / BOUNDARY_SCALE,
        bias_memory_s=tracking.bias_memory_s,
        flexure_per_degree=np.array(
            [
                tracking.flexure_subap_per_degree,
                tracking.flexure_subap_per_degree,
                np.deg2rad(tracking.flexure_deg_per_degree),
                tracking.flexure_magnification_per_degree,
            ]
        ),
        slew_limit_deg=tracking.slew_limit_deg,
        stale_sigma=np.array(
            [
                tracking.stale_shift_subap,
                tracking.stale_shift_subap,
                np.deg2rad(tracking.stale_rotation_deg),
                tracking.stale_magnification,
            ]
        ),
        acquires=settings.acquisition.auto,
        acquisition_amplitude_m=settings.acquisition.amplitude_m,
        n_modes_target=control.n_modes_target,
        update_threshold=np.array(
            [
                control.update_shift_subap,
                control.update_shift_subap,
                np.deg2rad(control.update_rotation_deg),
                control.update_magnification,
            ]
        ),
        update_gain_m=control.update_gain_nm * 1e-9,
        update_margin=control.update_margin,
        minimum_interval_s=control.minimum_interval_s,
    )
