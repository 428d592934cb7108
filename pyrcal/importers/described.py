"""Import arrays of an instrument that a file describes: one of your own, or a packaged one.

The arrays are a response, the modes it was measured with, and the light. Everything else is taken
from the instrument file.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pyrcal.importers.actuators import Mirror, combine
from pyrcal.importers.files import apply_unit, read_frames, read_slopes, usable_modes
from pyrcal.importers.frames import Frames, describe_images, describe_windows
from pyrcal.importers.imported import Array, Imported, Signals, in_arrays_file
from service.errors import MatrixError
from service.files.toml import read_toml
from service.instrument import instrument_path, load_instrument
from service.model.instrument import Instrument
from service.model.pupil_images import find_pupil_images

OFF_CENTRE_SUBAP = 0.25
"""Smallest reported distance of the file's image centres from those of the light, subapertures."""

WIDTH_TOLERANCE = 0.03
"""Largest relative difference of the pupil image in the file and in the frames."""

_REFERENCES = ("modes", "positions", "mode_to_actuator", "influence_functions", "influence_origin")


def from_described(
    source: str,
    arrays: Mapping[str, Array],
    instrument_file: str,
    unit: str | None,
    columns: Array | None,
) -> Imported:
    """Return an instrument of a file with the response and the modes of arrays.

    Parameters
    ----------
    source
        What the arrays were read from, for messages.
    arrays
        By role: ``matrix``, perhaps ``mode_to_actuator``, ``valid``, ``light``.
    instrument_file
        A packaged name, or the path of a file.
    unit
        Of the commands, OPD; None if unknown.
    columns
        ``(n_columns,)`` basis index of each column; None for the first ones.

    Raises
    ------
    ConfigurationError
        If there is no such instrument.
    MatrixError
        If the arrays do not belong to it.
    """
    path = instrument_path(instrument_file)
    instrument, tables = load_instrument(path), read_toml(path)
    if "matrix" not in arrays:
        raise MatrixError(
            f"{source}: found no matrix, expected one in addition to the instrument file"
        )
    notes = [f"telescope, sensor and mirror as {path.name} describes them"]
    mirror = _mirror(instrument, tables["mirror"], path.parent, arrays, notes)
    signals = _signals(source, instrument, tables["wfs"], arrays, mirror, notes)
    modes = usable_modes(signals, mirror, columns, notes)
    apply_unit(unit, signals, mirror, notes)
    changed = {name: dict(table) for name, table in tables.items()}
    changed["mirror"] = mirror.table
    changed["wfs"] |= signals.table
    slopes = changed.setdefault("slopes", {})
    if changed["wfs"].get("input", "slopes") != "slopes":
        # Both follow from the positions of the images on the frames.
        changed["wfs"].pop("pupil_separation_subap", None)
        slopes.pop("order", None)
    slopes.setdefault("orientation", "auto")
    # The file's numbers of modes are those of its own basis.
    if "mode_to_actuator" in mirror.arrays:
        changed.get("modes", {}).pop("n_modes", None)
    if changed.get("loop", {}).get("n_controlled", 0) > mirror.n_modes:
        del changed["loop"]["n_controlled"]
    return Imported(
        source=source,
        tables=changed,
        arrays={**signals.arrays, **modes, **mirror.arrays},
        centres_found="pupil_centres_px" in signals.table,
        notes=tuple(notes),
    )


def _mirror(
    instrument: Instrument,
    table: Mapping[str, Any],
    folder: Path,
    arrays: Mapping[str, Array],
    notes: list[str],
) -> Mirror:
    """Return the mirror of the file, with the modes of the arrays where there are some."""
    # The new file is in another folder, so paths relative to the old one must not stay.
    absolute = {
        key: str(folder.resolve() / value)
        for key, value in table.items()
        if key in _REFERENCES and isinstance(value, str)
    }
    places = getattr(instrument.mirror, "positions_m", None)
    mirror = Mirror(
        n_modes=instrument.modes.n_modes,
        n_actuators=instrument.modes.n_modes if places is None else len(places),
        table={**table, **absolute},
        arrays={},
    )
    if "mode_to_actuator" in arrays:
        if "modes" in table:
            raise MatrixError(
                "mode_to_actuator: found with an instrument file that has modes of its own, "
                "expected one with actuators"
            )
        mirror.table.pop("basis", None)
        combine(mirror, arrays["mode_to_actuator"], notes)
    return mirror


def _signals(
    source: str,
    instrument: Instrument,
    wfs: Mapping[str, Any],
    arrays: Mapping[str, Array],
    mirror: Mirror,
    notes: list[str],
) -> Signals:
    frames = read_frames(source, arrays, instrument.wfs.kind)
    if instrument.frames is not None and frames is None:
        raise MatrixError(
            f"{source}: matrix: found shape {np.shape(arrays['matrix'])}, expected camera frames: "
            'wfs.input = "frames"; give the mask of lit pixels or the mean frame as well'
        )
    if frames is None:
        signals = read_slopes(source, arrays, mirror.n_modes, notes)
        n, found = instrument.wfs.n_subapertures, signals.table["n_subapertures"]
        if found != n:
            # Another width would be another sensor, with other slopes.
            raise MatrixError(
                f"{source}: valid: found a mask that spans {found} subapertures, expected {n} as "
                "wfs.n_subapertures says"
            )
        signals.table = {"valid_subapertures": in_arrays_file("valid_subapertures")}
        return signals
    table: dict[str, Any] = {}
    if instrument.frames is not None:
        notes += _check_centres(wfs, frames.light, frames.light_name)
    else:
        # Frames can be fitted although the RTC of this instrument computes slopes from them.
        table = _locate_windows(source, instrument, frames, notes)
    arrays_found = {"interaction_matrix": frames.cube, "flux_frame": frames.light}
    return Signals(
        table=table, arrays=arrays_found, columns=0, has_mean_frame=frames.has_mean_frame
    )


def _locate_windows(
    source: str, instrument: Instrument, frames: Frames, notes: list[str]
) -> dict[str, Any]:
    """Return keys of ``[wfs]`` that make frames of an instrument whose RTC sends slopes."""
    images = find_pupil_images(frames.light, f"{source}: {frames.light_name}")
    width = instrument.wfs.pupil_diameter
    pixels = max(1, round(images.diameter_px / width))
    if abs(images.diameter_px / pixels / width - 1.0) > WIDTH_TOLERANCE:
        raise MatrixError(
            f"{source}: {frames.light_name}: found pupil images of {images.diameter_px:.1f} "
            f"pixels, expected a multiple of wfs.pupil_diameter_subap = {width:g}"
        )
    notes.append(describe_images(frames, images))
    return describe_windows(images, pixels)


def _check_centres(wfs: Mapping[str, Any], light: Array, name: str) -> list[str]:
    """Return a note if the file's image centres differ from those of the light."""
    centres = wfs.get("pupil_centres_px", "auto")
    if centres == "auto":
        return []
    try:
        found = find_pupil_images(light, name).centres_px
    except MatrixError:
        # The file's centres are enough: the light need not show them.
        return []
    # Each is compared with the nearest one, because the file may list them in another order.
    apart = np.hypot(*np.moveaxis(found[:, None] - np.asarray(centres, float), -1, 0))
    away = float(apart.min(axis=1).max()) / wfs.get("pixels_per_subaperture", 1)
    if away <= OFF_CENTRE_SUBAP:
        return []
    words = ", ".join(f"[{row:.2f}, {column:.2f}]" for row, column in found)
    return [
        f"wfs.pupil_centres_px is off by up to {away:.2f} subapertures from the pupil images in "
        f"{name}, which are centred at {words}: change the key if the light is right"
    ]
