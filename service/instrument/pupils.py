"""The pupil of an instrument file: a map, or the arms of a spider."""

from __future__ import annotations

import numpy as np

from service.errors import ConfigurationError
from service.files.toml import refuse
from service.instrument.schema import AboutTable, Section
from service.model.instrument import PupilMap

_LIT_FRACTION = 0.5
"""Illumination of a point, of the largest, above which it belongs to the pupil."""

_WIDTHS = (0.8, 1.1)
"""Plausible width of a map's light divided by ``diameter_m``; the corners of a segmented pupil
extend beyond it."""

_OFF_CENTRE = 0.02
"""Tolerated distance of a map's light from the middle of its array, as a fraction of the diameter.
"""


def read_pupil(file: Section[AboutTable], subaperture_m: float) -> PupilMap | None:
    """Return the pupil's map; None: it is a ring, perhaps with arms before it.

    Raises
    ------
    ConfigurationError
        One line: a key that contradicts another, or a map that is no pupil of this telescope.
    """
    about = file.said
    if (about.spiders_m is None) != (not about.spiders_deg):
        missing, other = ("spiders_m", "spiders_deg")
        if about.spiders_m is not None:
            missing, other = other, missing
        raise ConfigurationError(f"{file.where(missing)}: missing beside instrument.{other}")
    if about.pupil is None:
        if about.pupil_pitch_m is not None:
            raise ConfigurationError(
                f"{file.where('pupil_pitch_m')}: has no meaning without instrument.pupil"
            )
        return None
    for key in ("obscuration_ratio", "spiders_m"):
        if key in file.given:
            raise ConfigurationError(
                f"{file.where(key)}: has no meaning beside instrument.pupil, whose map has it"
            )
    return _checked(file, subaperture_m)


def _checked(file: Section[AboutTable], subaperture_m: float) -> PupilMap:
    where, diameter_m = file.where("pupil"), file.said.diameter_m
    lit = np.asarray(file.array("pupil"), dtype=np.float64)
    if lit.ndim != 2 or min(lit.shape) < 2:
        refuse(where, f"shape {lit.shape}", "(ny, nx), a map of the pupil")
    if not np.isfinite(lit).all() or lit.min() < 0.0 or lit.max() > 1.0:
        refuse(where, "values that are not 0 to 1", "the share of each point that is lit")
    rows, columns = (np.flatnonzero((lit > _LIT_FRACTION).any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        refuse(where, "no lit point", f"a pupil of {diameter_m:g} m")
    pitch_m = file.said.pupil_pitch_m or diameter_m / max(lit.shape)
    if pitch_m > subaperture_m:
        refuse(
            file.where("pupil_pitch_m"),
            f"{pitch_m:.3g} m between points",
            f"at most a subaperture, {subaperture_m:.3g} m",
        )
    for name, place, n in (("y", rows, lit.shape[0]), ("x", columns, lit.shape[1])):
        wide_m = (place[-1] - place[0] + 1) * pitch_m
        if not _WIDTHS[0] <= wide_m / diameter_m <= _WIDTHS[1]:
            refuse(
                where,
                f"light over {wide_m:.3g} m along {name}",
                f"about diameter_m = {diameter_m:g}: give pupil_pitch_m, metres in the pupil plane",
            )
        aside_m = ((place[0] + place[-1]) / 2 - (n - 1) / 2) * pitch_m
        if abs(aside_m) > _OFF_CENTRE * diameter_m:
            refuse(
                where,
                f"light {aside_m:+.3g} m beside the middle of the array along {name}",
                "a map that is centred on the pupil",
            )
    return PupilMap(lit=lit, pitch_m=pitch_m)
