"""What a night of the whole service came to, as one row of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pyrcal_studies.campaign.observatory import Observatory
from pyrcal_studies.campaign.observatory_checks import Outcome, Publication
from pyrcal_studies.campaign.observatory_dome import START_NS, Moment
from pyrcal_studies.campaign.rows import Row
from service.model.misregistration import BOUNDARY_SCALE
from service.tracking import alarms
from service.tracking.products import MatrixState

GOOD = np.array([0.02, 0.02, 0.02, 0.001])
"""An α this near the truth is a good one: two floors of the shift (boundary units)."""

CORRECTED = np.array([0.03, 0.03, 0.03, 0.002])
"""A matrix made for an α this near the truth corrects a jump: a third of what is to be flagged."""

STEADY_S = 10.0
"""After the first own matrix: the loop has settled and α has been confirmed."""

AFTER_JUMP_S = 15.0
"""What has been corrected so long after a jump is tracking again; before, it is not judged so."""

FLAGS = ("registration.jump-suspected", "registration.jump", "registration.passive-jump")
"""Log entries that say that the mirror has jumped, or may have."""

Array = NDArray[np.float64]


def row_of(night: Observatory, jump_times_s: tuple[float, ...]) -> Row:
    """Return the row; errors in boundary units (subapertures, degrees, ratio)."""
    publications = night.publications()
    own_s = min((p.swap.time_s for p in publications if _own(p)), default=None)
    good_s = first_good_s(night)
    begin_s = STEADY_S + max(own_s or 0.0, good_s or 0.0)
    steady = [m for m in night.dome.moments if m.time_s >= begin_s]
    errors, sigma = tracking_errors(night, begin_s, jump_times_s)
    return {
        "good_alpha_s": good_s,
        "own_matrix_s": own_s,
        "modes_reached": night.dome.moments[-1].n_controlled,
        "steady_from_s": begin_s,
        "tracking_rms": _rms(errors),
        "tracking_sigma": _rms(sigma),
        "tracking_inside_2_sigma": np.mean(np.abs(errors) <= 2.0 * sigma, axis=0).tolist()
        if len(errors)
        else None,
        "jumps": [jump_row(night, publications, t) for t in jump_times_s],
        "wavefront_nm": wavefront_rms_nm(steady),
        "dither_nm": float(np.sqrt(np.mean([m.dither_nm**2 for m in steady]))) if steady else None,
        "windows": [night.state.windows.accepted, night.state.windows.refused],
        "published": [publication_row(p) for p in publications],
        "refused": sum(r.state is MatrixState.REFUSED for r in night.state.matrices.reconstructors),
        "unstable": sum(p.outcome is Outcome.DIVERGED for p in publications),
        "log": [
            (round((e.t_ns_utc - START_NS) * 1e-9, 2), e.level.value, e.name, e.text)
            for e in night.state.log
        ],
    }


def recovery_of(night: Observatory, jump_s: float) -> Row:
    """Return when a loop that a jump lost was opened and back on all modes, after the jump."""
    moments = night.dome.moments
    before = [m for m in moments if jump_s - 3.0 < m.time_s < jump_s]
    opened_s = next((m.time_s for m in moments if m.time_s > jump_s and not m.closed), None)
    back_s = None
    if opened_s is not None and before:
        n_modes = before[-1].n_controlled
        later = (m for m in moments if m.time_s > opened_s)
        back_s = next((m.time_s for m in later if m.closed and m.n_controlled >= n_modes), None)
    lost_s = (g.time_s for g in night.glances if g.time_s > jump_s and alarms.LOST in g.alarms)
    return {
        "lost_after_s": _after(next(lost_s, None), jump_s),
        "opened_after_s": _after(opened_s, jump_s),
        "all_modes_after_s": _after(back_s, jump_s),
        "before_nm": wavefront_rms_nm(before),
        "after_nm": None
        if back_s is None
        else wavefront_rms_nm([m for m in moments if m.time_s > back_s + 1.0]),
    }


def _after(time_s: float | None, jump_s: float) -> float | None:
    return None if time_s is None else round(time_s - jump_s, 2)


def first_good_s(night: Observatory) -> float | None:
    """Return when α was first within ``GOOD`` of the truth."""
    for moment, glance in zip(night.dome.moments, night.glances, strict=True):
        if glance.alpha is not None:
            error = (glance.alpha - moment.alpha.vector) * BOUNDARY_SCALE
            if np.all(np.abs(error) <= GOOD):
                return glance.time_s
    return None


def tracking_errors(
    night: Observatory, begin_s: float, jump_times_s: tuple[float, ...] = ()
) -> tuple[Array, Array]:
    """Return ``(n, 4)`` errors of what the service held to be true, and their 1 σ, block by block.

    Against where the mirror is at that moment: the age of the estimate is part of the error. What
    comes within ``AFTER_JUMP_S`` of a jump is left out.
    """
    found = [
        (glance.alpha - moment.alpha.vector, glance.sigma)
        for moment, glance in zip(night.dome.moments, night.glances, strict=True)
        if glance.alpha is not None
        and glance.time_s >= begin_s
        and not any(0.0 <= glance.time_s - t < AFTER_JUMP_S for t in jump_times_s)
    ]
    errors, sigma = (np.array([pair[k] for pair in found]).reshape(-1, 4) for k in range(2))
    return errors * BOUNDARY_SCALE, sigma * BOUNDARY_SCALE


def jump_row(night: Observatory, publications: list[Publication], time_s: float) -> Row:
    """Return how long after a jump it was flagged, and a corrected matrix applied, seconds."""
    flags = (
        (entry.t_ns_utc - START_NS) * 1e-9 - time_s
        for entry in night.state.log
        if entry.name in FLAGS
    )
    corrected = (
        p.swap.time_s - time_s for p in publications if p.swap.time_s > time_s and _corrects(p)
    )
    return {
        "at_s": time_s,
        "flagged_s": min((t for t in flags if t > 0.0), default=None),
        "corrected_s": min(corrected, default=None),
    }


def publication_row(publication: Publication) -> Row:
    """Return one published matrix as JSON can hold it."""
    swap = publication.swap
    return {
        "id": swap.id,
        "at_s": swap.time_s,
        "n_modes": swap.n_modes,
        "gate_radius": None if swap.gate is None else swap.gate.worst_pole_radius,
        "true_radius": swap.radius,
        "before_nm": publication.before_nm,
        "after_nm": publication.after_nm,
        "outcome": publication.outcome.value,
    }


def wavefront_rms_nm(moments: list[Moment]) -> float | None:
    """Return the RMS over these moments, or None where there is none."""
    if not moments:
        return None
    return float(np.sqrt(np.mean([m.wavefront_nm**2 for m in moments])))


def _own(publication: Publication) -> bool:
    return publication.swap.made_for is not None


def _corrects(publication: Publication) -> bool:
    made_for = publication.swap.made_for
    if made_for is None:
        return False
    error = (made_for.vector - publication.swap.alpha.vector) * BOUNDARY_SCALE
    return bool(np.all(np.abs(error) <= CORRECTED))


def _rms(errors: Array) -> list[float] | None:
    return np.sqrt(np.mean(errors**2, axis=0)).tolist() if len(errors) else None
