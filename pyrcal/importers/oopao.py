"""Import OOPAO objects: telescope, deformable mirror, wavefront sensor, M2C, calibration.

OOPAO is not imported: its objects are accessed by their attributes, so an ``.npz`` with the same
names is accepted as well. OOPAO's geometry was read from version 1.0.0 and is tested with it:

- Its mirror and its modulation are defined on a pupil of n points whose first and last are one
  diameter apart, while a pupil of n samples is n steps wide: lengths are multiplied by (n - 1) / n,
  the modulation by n / (n - 1).
- Its ``MisRegistration`` scales, then rotates, then moves the mirror by minus the shift.
- Its mirrors transmit: strokes are OPD, and there is no double pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.imported import Array, Imported, in_arrays_file, matrix_of, orient_matrix
from pyrcal.importers.registration import decompose
from service.errors import ConfigurationError, MatrixError
from service.model.misregistration import Misregistration, rotation
from service.model.pupil_images import find_pupil_images

_Sensor = tuple[dict[str, Any], NDArray[np.bool_], dict[str, Any]]
"""``[wfs]``, its valid subapertures, and ``[slopes]``."""

_FULL_FRAME = "fullFrame"
"""Beginning of the names of OOPAO's processings whose signal is the whole detector."""

Oopao = Any
"""An object of OOPAO's own classes, which are known by their attributes."""

PYRAMID, LENSLETS = "pyramid", "shackHartmann"

_MAX_NUMBER = 1e6
"""Largest allowed value of any attribute, in its own unit."""


class _Rule(NamedTuple):
    """Requirement on a saved attribute."""

    expected: str
    fits: Callable[[Array], bool]
    single: bool = True
    """True for a number or a word, False for an array."""

    sensor: str | None = None
    """The only kind of sensor that has it; None for all."""

    needed: bool = True


def _number(expected: str, least: float) -> _Rule:
    def fits(values: Array) -> bool:
        is_number = values.size == 1 and values.dtype.kind in "iufb"
        return is_number and bool(least <= values.item() <= _MAX_NUMBER)

    return _Rule(expected, fits)


def _count(least: int) -> _Rule:
    return _number(f"a number of at least {least}", least)


def _array(*axes: int) -> _Rule:
    def fits(values: Array) -> bool:
        return values.dtype.kind in "iufb" and values.ndim in axes and values.size > 0

    return _Rule(f"numbers with {' or '.join(map(str, axes))} axes", fits, single=False)


_ANY = _number("a finite number", -_MAX_NUMBER)
_POSITIVE = _number("a number above 0", np.finfo(float).tiny)
_OPTIONAL = _ANY._replace(needed=False)
_WORD = _Rule("a word", lambda values: values.size == 1 and isinstance(values.item(), str))

SAVED = {
    "tel": {
        "D": _POSITIVE,
        "resolution": _count(2),
        "pupil": _array(2),
        "pupilReflectivity": _array(0, 2)._replace(needed=False),
    },
    "ngs": {"wavelength": _POSITIVE},
    "dm": {
        "modes": _array(2, 3),
        "altitude": _OPTIONAL,
        "initial_coordinates": _array(2),
        "nActAlongDiameter": _count(2),
        "mechCoupling": _POSITIVE,
        **dict.fromkeys(("sign", "flip_", "flip_lr"), _OPTIONAL),
        "validAct": _array(1, 2)._replace(needed=False),
    },
    "dm.misReg": dict.fromkeys(
        (
            *("rotationAngle", "shiftX", "shiftY", "anamorphosisAngle"),
            *("radialScaling", "tangentialScaling"),
        ),
        _ANY,
    ),
    "wfs": {
        "tag": _WORD,
        "nSubap": _count(1),
        "modulation": _ANY._replace(sensor=PYRAMID),
        "n_pix_separation": _ANY._replace(sensor=PYRAMID),
        "binning": _count(1)._replace(sensor=PYRAMID),
        "postProcessing": _WORD._replace(sensor=PYRAMID),
        "n_pix_edge": _OPTIONAL._replace(sensor=PYRAMID),
        **dict.fromkeys(("rooftop", "theta_rotation", "old_mask"), _OPTIONAL),
        "user_modulation_path": _array(2)._replace(needed=False),
        "validI4Q": _array(2)._replace(needed=False),
        "validSignal": _array(1, 2)._replace(needed=False),
        "referenceSignal_2D": _array(2)._replace(needed=False),
        "valid_subapertures": _array(2)._replace(sensor=LENSLETS),
        "pixel_scale": _POSITIVE._replace(sensor=LENSLETS),
        "n_pix_subap": _count(1)._replace(sensor=LENSLETS),
        "threshold_cog": _ANY._replace(sensor=LENSLETS),
        "is_geometric": _OPTIONAL,
    },
}
"""Attributes that are read from each object, and what they must be."""

_MAX_SHAPE_DEVIATION = 1e-3
"""Largest accepted deviation of an influence function from its Gaussian, relative to its height."""

_LIT_SHARE = 0.5
"""Share of a subaperture that the pupil must fill, where the signal is the whole detector."""

_MAX_SEEMING_PX = 0.6
"""Largest error towards the middle of an unmodulated pupil image found by its response."""

_MAX_PATH_DEVIATION = 0.02
"""Largest distance of a point of a modulation path from an ellipse, relative to its semi-axis."""

_SAME_AXES = 1e-3
"""Relative difference of the semi-axes of a modulation below which it is a circle."""

_SAMPLED_ACTUATORS = 24
"""Number of influence functions that are compared with the Gaussian."""


def from_oopao(
    tel: Oopao,
    dm: Oopao,
    wfs: Oopao,
    calib: Oopao = None,
    M2C: Array | None = None,  # noqa: N803 - OOPAO's own name
    ngs: Oopao = None,
) -> Imported:
    """Return OOPAO's telescope, mirror, sensor and calibration as pyrcal's instrument and matrix.

    Parameters
    ----------
    tel, dm, wfs
        ``Telescope``, ``DeformableMirror``, and ``Pyramid`` or ``ShackHartmann``.
    calib
        ``CalibrationVault`` of ``InteractionMatrix``, or its ``D``; None for the instrument only.
    M2C
        Modes to commands, ``(n_actuators, n_modes)``; None if ``calib`` is zonal.
    ngs
        ``Source`` of the sensor; None for the telescope's.

    Raises
    ------
    ConfigurationError
        If the objects are of other classes, or have properties that pyrcal does not model.
    MatrixError
        If ``calib`` or ``M2C`` does not belong to them.
    """
    notes: list[str] = []
    if getattr(dm, "altitude", None) is not None:
        # A conjugated mirror has another registration for every star.
        raise ConfigurationError(
            f"dm.altitude: found {dm.altitude} m, expected None: a mirror in the pupil"
        )
    wavelength_m = _wavelength_m(tel, wfs, ngs)
    sensor, valid, slopes = _sensor(tel, wfs, notes)
    functions = _functions(tel, dm)
    mirror, arrays = _mirror(tel, dm, functions, notes)
    if "positions" in arrays:
        notes += _describe_registration(dm.misReg, tel, len(valid))
    pupil, diameter_m = _lit_pupil(tel, sensor, notes)
    n_actuators = functions.shape[1]
    if M2C is None:
        mirror["basis"] = "zonal"
        n_modes = n_actuators
    else:
        shape = "(n_actuators, n_modes)"
        strokes = orient_matrix(_numpy(M2C), n_actuators, None, "M2C", shape, notes)
        n_modes = strokes.shape[1]
        mirror["mode_to_actuator"] = in_arrays_file("mode_to_actuator")
        arrays["mode_to_actuator"] = strokes
    if calib is not None:
        measured = _numpy(getattr(calib, "D", calib))
        if sensor.get("input") is None:
            n_slopes = 2 * int(valid.sum())
            arrays["interaction_matrix"] = matrix_of(measured, n_slopes, n_modes, notes=notes)
        else:
            arrays |= _frames(wfs, measured, n_modes, sensor, notes)
            sensor |= _fft_grid(tel, wfs, float(arrays["interaction_matrix"].shape[-1]))
    arrays |= {"valid_subapertures": valid.astype(np.uint8), "pupil": pupil}
    return Imported(
        source="OOPAO",
        tables={
            "instrument": {
                "name": "oopao",
                "diameter_m": diameter_m,
                "pupil": in_arrays_file("pupil"),
                "stop": "telescope",
                "double_pass": False,
            },
            "wfs": {
                **sensor,
                "wavelength_m": wavelength_m,
                "valid_subapertures": in_arrays_file("valid_subapertures"),
            },
            "mirror": mirror,
            "slopes": slopes,
        },
        arrays=arrays,
        notes=tuple(notes),
    )


def _numpy(values: Oopao) -> Array:
    """Return an array of this machine's memory."""
    return np.asarray(values.get() if hasattr(values, "get") else values)


def _wavelength_m(tel: Oopao, wfs: Oopao, ngs: Oopao) -> float:
    source = ngs or getattr(wfs, "src", None) or getattr(tel, "src", None)
    if source is None or not hasattr(source, "wavelength"):
        raise ConfigurationError(
            "ngs: found no source with a wavelength, expected the sensor's source"
        )
    return float(source.wavelength)


def _lit_pupil(
    tel: Oopao, sensor: dict[str, Any], notes: list[str]
) -> tuple[NDArray[np.float32], float]:
    """Return the pupil without a dark rim, and its diameter; ``sensor`` is changed to match.

    A padded telescope has an array that is wider than its light, and ``tel.D`` is the array's.
    """
    # OOPAO's reflectivity is that of the intensity, the model's pupil is an amplitude.
    mask, reflectivity = _numpy(tel.pupil), _numpy(getattr(tel, "pupilReflectivity", 1.0))
    side = int(tel.resolution)
    for name, values, shapes in (
        ("pupil", mask, {(side, side)}),
        ("pupilReflectivity", reflectivity, {(), (side, side)}),
    ):
        if values.shape not in shapes:
            raise ConfigurationError(
                f"tel.{name}: found shape {values.shape}, expected ({side}, {side}) as "
                "tel.resolution says"
            )
    pupil = np.asarray(mask * np.sqrt(reflectivity), dtype=np.float32)
    lit = np.argwhere(pupil > 0.0)
    if not len(lit):
        raise ConfigurationError("tel.pupil: found no light, expected some")
    rim = int(min(lit.min(), side - 1 - lit.max()))
    if not rim:
        return pupil, float(tel.D)
    share = (side - 2 * rim) / side
    diameter_m = float(tel.D) * share
    sensor["pupil_diameter_subap"] = sensor["n_subapertures"] * share
    # Modulation and rooftop are in wavelengths over tel.D, which is the array's width.
    for key in {"modulation_lambda_over_d", "rooftop_lambda_over_d"} & sensor.keys():
        sensor[key] *= share
    if "modulation_ellipse" in sensor:
        ellipse = sensor["modulation_ellipse"]
        ellipse["axes_lambda_over_d"] = [axis * share for axis in ellipse["axes_lambda_over_d"]]
    notes.append(
        f"tel.D = {float(tel.D):g} m is that of a padded array: a dark rim of {rim} points is cut, "
        f"so that the pupil is {diameter_m:.4g} m wide, {sensor['pupil_diameter_subap']:.4g} of "
        f"{sensor['n_subapertures']} subapertures"
    )
    return pupil[rim : side - rim, rim : side - rim], diameter_m


def _steps(tel: Oopao) -> float:
    """Return a length of a pupil that is n samples wide over one of OOPAO's."""
    return (int(tel.resolution) - 1) / int(tel.resolution)


# --- the sensor


def _sensor(tel: Oopao, wfs: Oopao, notes: list[str]) -> _Sensor:
    """Return ``[wfs]``, its valid subapertures, and ``[slopes]``."""
    kind = getattr(wfs, "tag", type(wfs).__name__)
    if kind == PYRAMID:
        return _pyramid(tel, wfs, notes)
    if kind == LENSLETS:
        return _lenslets(wfs, notes)
    raise ConfigurationError(f"wfs.tag: found {kind!r}, expected {PYRAMID!r} or {LENSLETS!r}")


def _pyramid(tel: Oopao, wfs: Oopao, notes: list[str]) -> _Sensor:
    whole = wfs.postProcessing.startswith(_FULL_FRAME)
    if not whole and not wfs.postProcessing.startswith("slopesMaps"):
        raise ConfigurationError(
            f"wfs.postProcessing: found {wfs.postProcessing!r}, expected 'slopesMaps', 'fullFrame' "
            "or a name that begins with one of them"
        )
    if wfs.postProcessing not in {"slopesMaps", _FULL_FRAME, f"{_FULL_FRAME}_sum_flux"}:
        notes.append(
            f"wfs.postProcessing = {wfs.postProcessing!r} normalises by a constant: gains of all "
            "modes differ from 1 alike"
        )
    # OOPAO's old mask has neither.
    rooftop, turn_rad = (
        0.0 if getattr(wfs, "old_mask", False) else float(getattr(wfs, name, None) or 0.0)
        for name in ("rooftop", "theta_rotation")
    )
    if turn_rad:
        notes.append("wfs.theta_rotation: faces that are turned are not in pyrcal's model")
    binning = int(wfs.binning)
    separation = (int(wfs.nSubap) + float(wfs.n_pix_separation)) / binning
    sensor: dict[str, Any] = {"kind": "pyramid", "pupil_separation_subap": separation}
    if rooftop:
        # OOPAO's number is the length times the distance of the images in rad of one point.
        apart = np.pi * (int(wfs.nSubap) + float(wfs.n_pix_separation))
        sensor["rooftop_lambda_over_d"] = rooftop * int(tel.resolution) / apart
    slopes = {"orientation": "auto", "normalisation": "global"}
    if whole:
        valid = _lit_subapertures(_numpy(tel.pupil), int(wfs.nSubap) // binning)
        sensor["input"] = "normalised-frames"
    else:
        valid = _numpy(_needed(wfs, "validI4Q")).astype(bool)
        slopes["order"] = "xy"
    sensor["n_subapertures"] = len(valid)
    margin = getattr(wfs, "n_pix_edge", None)
    if margin is not None:
        across = 2.0 * (int(wfs.nSubap) + float(margin)) + float(wfs.n_pix_separation)
        sensor |= _fft_grid(tel, wfs, across)
    return sensor | _modulation(tel, wfs, notes), valid, slopes


def _fft_grid(tel: Oopao, wfs: Oopao, width_px: float) -> dict[str, Any]:
    """Return the key of the grid of OOPAO's FFT, so many pixels of its detector wide."""
    points, left = divmod(int(tel.resolution), int(wfs.nSubap))
    # A padded telescope is cut to its light, and a binned detector has other points.
    if left or int(wfs.binning) > 1 or not _is_filled(tel):
        return {}
    grid = {"points_per_subaperture": points, "width_subap": width_px}
    if wfs.modulation > 0 and getattr(wfs, "user_modulation_path", None) is None:
        usual = 4 * math.ceil(2.0 * math.pi * float(wfs.modulation) / 4.0)
        n_points = int(getattr(wfs, "nTheta", usual))
        grid |= {"modulation_points": n_points} if n_points % 4 == 0 else {}
    return {"fft_grid": grid}


def _is_filled(tel: Oopao) -> bool:
    """Return True if the pupil reaches the edge of its array."""
    lit = np.argwhere(_numpy(tel.pupil) > 0)
    return bool(len(lit)) and int(lit.min()) == 0 and int(lit.max()) == int(tel.resolution) - 1


def _modulation(tel: Oopao, wfs: Oopao, notes: list[str]) -> dict[str, Any]:
    """Return the keys of the modulation: a circle, or the ellipse of the user's own path."""
    own = getattr(wfs, "user_modulation_path", None)
    if own is None:
        return {"modulation_lambda_over_d": float(wfs.modulation) / _steps(tel)}
    path = np.asarray(own, dtype=float).T / _steps(tel)
    if len(path) != 2 or not np.any(path):
        raise ConfigurationError(
            f"wfs.user_modulation_path: found shape {path.T.shape}, expected pairs [x, y] that are "
            "not all 0"
        )
    # Over an ellipse the mean square of a coordinate is half that of its semi-axis.
    squares, axes = np.linalg.eigh(2.0 * path @ path.T / path.shape[1])
    lengths = np.sqrt(np.maximum(squares, np.finfo(float).tiny))
    off = np.linalg.norm(axes.T @ path / lengths[:, None], axis=0)
    if np.abs(off - 1.0).max() > _MAX_PATH_DEVIATION:
        notes.append(
            "wfs.user_modulation_path is no ellipse about the axis: that of the same mean squares "
            "is taken"
        )
    if lengths[1] / lengths[0] - 1.0 < _SAME_AXES:
        return {"modulation_lambda_over_d": float(np.sqrt(lengths.prod()))}
    angle_deg = float(np.rad2deg(np.arctan2(axes[1, 1], axes[0, 1])))
    return {
        "modulation_ellipse": {
            "axes_lambda_over_d": [float(lengths[1]), float(lengths[0])],
            "angle_deg": round(angle_deg, 6) % 180.0,
        }
    }


def _needed(owner: Oopao, name: str) -> Array:
    """Return an attribute that only some processings of the signal have."""
    values = getattr(owner, name, None)
    if values is None:
        raise ConfigurationError(
            f"found no wfs.{name}; expected it with wfs.postProcessing = {owner.postProcessing!r}"
        )
    return _numpy(values)


def _lit_subapertures(pupil: Array, n: int) -> NDArray[np.bool_]:
    """Return the subapertures ``(n, n)`` that the pupil ``(n_points, n_points)`` half fills."""
    points = len(pupil) // n
    light = pupil[: n * points, : n * points].reshape(n, points, n, points).mean(axis=(1, 3))
    return np.asarray(light >= _LIT_SHARE)


def _frames(
    wfs: Oopao, measured: Array, n_modes: int, sensor: dict[str, Any], notes: list[str]
) -> dict[str, Array]:
    """Return a matrix of the whole detector as frames; add their windows to ``[wfs]``.

    OOPAO divides frames by their sum, and keeps the mean frame as the reference signal. Without it
    the images are located by the strength of the response.
    """
    mean = getattr(wfs, "referenceSignal_2D", None)
    lit = getattr(wfs, "validSignal", None if mean is None else np.ones_like(_numpy(mean)))
    if lit is None or _numpy(lit).ndim != 2:
        side = math.isqrt(max(measured.shape))
        lit = np.ones((side, side)) if side**2 in measured.shape else _needed(wfs, "validSignal")
    lit = _numpy(lit).astype(bool)
    response = matrix_of(measured, int(lit.sum()), n_modes, notes=notes)
    cube = np.zeros((response.shape[1], *lit.shape), dtype=response.dtype)
    cube[:, lit] = response.T
    arrays = {"interaction_matrix": cube}
    if mean is not None:
        arrays["flux_frame"] = _numpy(mean)
        sensor["pupil_centres_px"] = "auto"
        return arrays
    sensor["pupil_centres_px"] = find_image_centres(cube, sensor, notes)
    return arrays


def find_image_centres(cube: Array, sensor: dict[str, Any], notes: list[str]) -> list[list[float]]:
    """Return windows of whole pixels around the pupil images, by the strength of the response.

    Light between the images responds as well, so that unmodulated images seem up to half a pixel
    too close to one another. A common movement of all four by as much is therefore ignored.
    """
    sides = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) / 2.0
    nominal = (len(cube[0]) - 1) / 2.0 + sides * sensor["pupil_separation_subap"]
    strength = np.sqrt(np.mean(np.square(cube, dtype=float), axis=0))
    try:
        off = find_pupil_images(strength, "calib.D").centres_px - nominal
    except MatrixError:
        off = np.zeros((4, 2))
    inwards = np.clip(-2.0 * float(np.mean(off * sides)), 0.0, _MAX_SEEMING_PX)
    moved = np.round(off + 2.0 * inwards * sides)
    centres: list[list[float]] = (nominal + moved).tolist()
    if np.any(moved):
        notes.append(f"pupil images off OOPAO's own quadrants, as the response shows: {centres}")
    return centres


def _lenslets(wfs: Oopao, notes: list[str]) -> _Sensor:
    threshold = float(wfs.threshold_cog)
    centroid: dict[str, Any] = {"centroid": "cog"}
    if getattr(wfs, "is_geometric", False):
        centroid = {"centroid": "gradient"}
    elif threshold > 0.0:
        centroid = {"centroid": "threshold", "threshold": threshold, "partly_lit": "leave out"}
    notes.append("slopes of OOPAO's lenslets are in a unit of their own: one gain of all modes")
    sensor = {
        "kind": "shack-hartmann",
        "n_subapertures": int(wfs.nSubap),
        "pixels_per_subaperture": int(wfs.n_pix_subap),
        "pixel_scale_arcsec": float(wfs.pixel_scale),
        **centroid,
    }
    valid = _numpy(wfs.valid_subapertures).astype(bool)
    return sensor, valid, {"order": "xy", "orientation": "auto"}


# --- the mirror


def _functions(tel: Oopao, dm: Oopao) -> Array:
    """Return influence functions ``(tel.resolution ** 2, n_actuators)``.

    OOPAO's ``InfluenceFunctions`` has them as a cube ``influence_function_2D``.
    """
    side = int(tel.resolution)
    cube = getattr(dm, "influence_function_2D", None)
    if cube is not None and not hasattr(dm, "modes"):
        cube = _numpy(cube)
        if cube.ndim != 3 or cube.shape[1:] != (side, side):
            raise ConfigurationError(
                f"influence_function_2D: found shape {cube.shape}, expected (n_actuators, {side}, "
                f"{side}) as tel.resolution says"
            )
        return np.asarray(cube.reshape(len(cube), -1).T)
    functions = _numpy(dm.modes)
    if functions.ndim != 2 or len(functions) != side**2:
        raise ConfigurationError(
            f"dm.modes: found shape {functions.shape}, expected (tel.resolution ** 2, n_actuators) "
            f"= ({side**2}, n)"
        )
    return functions


def _mirror(
    tel: Oopao, dm: Oopao, functions: Array, notes: list[str]
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return ``[mirror]`` and its arrays: drawn where it is OOPAO's Gaussian one, else a cube."""
    side = int(tel.resolution)
    places = _places(dm, functions.shape[1], notes)
    if places is not None and _is_gaussian(dm, places, functions, float(tel.D)):
        return _gaussian(tel, dm, places)
    notes.append(
        "dm.modes are not the Gaussian functions of dm.coordinates: taken as a cube, so α is "
        "relative to this mirror's position, and its surface outside the pupil is unknown"
    )
    cube = np.ascontiguousarray(functions.T.reshape(-1, side, side), dtype=np.float32)
    table = {
        "influence_functions": in_arrays_file("influence_functions"),
        "modes_pitch_m": float(tel.D) / side,
    }
    return table, {"influence_functions": cube}


def _places(dm: Oopao, n_functions: int, notes: list[str]) -> Array | None:
    """Return where the actuators of the functions are drawn; None if that is not known.

    With a scalar ``actuator_selection`` OOPAO drops functions, and leaves the coordinates as they
    were: ``validAct`` lists those that are left.
    """
    places = getattr(dm, "initial_coordinates", None)
    if places is None:
        return None
    places = _numpy(places)
    if places.ndim != 2 or places.shape[1] != 2:
        raise ConfigurationError(
            f"dm.initial_coordinates: found shape {places.shape}, expected (n_actuators, 2)"
        )
    if len(places) == n_functions:
        return places
    kept = getattr(dm, "validAct", None)
    if kept is not None:
        kept = _numpy(kept)
        indices = np.flatnonzero(kept) if kept.dtype == bool else kept.astype(np.intp)
        if len(indices) == n_functions and max(indices, default=0) < len(places):
            notes.append(
                f"dm.initial_coordinates lists {len(places)} actuators, dm.modes {n_functions}: "
                "those of dm.validAct are taken"
            )
            return np.asarray(places[indices])
    longer = "dm.initial_coordinates" if len(places) > n_functions else "dm.modes"
    notes.append(
        f"dm.initial_coordinates lists {len(places)} actuators, dm.modes {n_functions} functions: "
        f"{longer} is the longer one, and which belong together is not known; save dm.validAct"
    )
    return None


def _gaussian(tel: Oopao, dm: Oopao, places: Array) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return ``[mirror]`` of OOPAO's own Gaussian mirror at its position without misReg."""
    places = places.astype(float) * _steps(tel) * _flip_signs(dm)
    table = {
        "layout": "positions",
        "positions": in_arrays_file("positions"),
        "pitch_m": float(tel.D) / float(dm.nActAlongDiameter) * _steps(tel),
        "influence": "gaussian",
        "coupling": float(dm.mechCoupling),
    }
    return table, {"positions": places}


def _flip_signs(dm: Oopao) -> NDArray[np.float64]:
    """Return the sign of x and y from the flips of OOPAO's influence functions."""
    x, y = (-1.0, -1.0) if getattr(dm, "flip_", False) else (1.0, 1.0)
    return np.array([-x if getattr(dm, "flip_lr", False) else x, y])


def _is_gaussian(dm: Oopao, places: Array, functions: Array, diameter_m: float) -> bool:
    """Return True if the influence functions are the Gaussians given by the attributes."""
    if getattr(dm, "sign", 1) != 1:
        return False
    # A sample is enough, because all are drawn by one formula.
    some = np.unique(np.linspace(0, len(places) - 1, _SAMPLED_ACTUATORS).astype(int))
    drawn = _compute_gaussians(dm, places[some].astype(float), len(functions), diameter_m)
    return bool(np.abs(drawn - functions[:, some].T).max() <= _MAX_SHAPE_DEVIATION)


def _compute_gaussians(dm: Oopao, places_m: Array, n_points: int, diameter_m: float) -> Array:
    """Return OOPAO's Gaussians ``(n, n_points)`` of actuators that its misReg moves."""
    moved = dm.misReg
    linear = _linear(moved)
    along = np.linspace(-0.5, 0.5, math.isqrt(n_points)) * diameter_m
    points = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2) * _flip_signs(dm)
    centres = places_m @ linear.T - [float(moved.shiftX), float(moved.shiftY)]
    # OOPAO scales the Gaussian's width with the pitch along unrotated axes of the anamorphosis
    axes = rotation(np.deg2rad(float(moved.anamorphosisAngle))).T
    scales = 1.0 + np.array([float(moved.radialScaling), float(moved.tangentialScaling)])
    pitch = diameter_m / float(dm.nActAlongDiameter) * scales
    apart = (points - centres[:, None]) @ axes / pitch
    return np.asarray(float(dm.mechCoupling) ** np.square(apart).sum(axis=-1))


# --- its misregistration


def _linear(moved: Oopao) -> NDArray[np.float64]:
    """Return what a ``MisRegistration`` does to coordinates, ``(2, 2)``, before its shift."""
    axes = rotation(np.deg2rad(float(moved.anamorphosisAngle)))
    radial, tangential = 1.0 + float(moved.radialScaling), 1.0 + float(moved.tangentialScaling)
    # OOPAO counts the angle of the anamorphosis opposite to its rotation
    stretch = axes.T @ np.diag([radial, tangential]) @ axes
    return np.asarray(rotation(np.deg2rad(float(moved.rotationAngle))) @ stretch)


def _describe_registration(moved: Oopao, tel: Oopao, n_subapertures: int) -> tuple[str, ...]:
    """Return the registration that a mirror has been given, as a note; nothing where none."""
    if np.allclose(_linear(moved), np.eye(2)) and not moved.shiftX and not moved.shiftY:
        return ()
    alpha = registration_of(moved, tel, n_subapertures)
    # A fit has 1 sigma of 0.001 subapertures: two decimals would look like a disagreement.
    x, y, turned, size = (round(value, 4) + 0.0 for value in alpha.to_boundary().values())
    stretched = ""
    if alpha.anamorphosis is not None:
        stretched = ", stretched by {:+.4f}, {:+.4f}".format(*alpha.anamorphosis)
    return (
        "α is relative to OOPAO's mirror without its misReg, which is "
        f"α = ({x:+.4f}, {y:+.4f} subap, {turned:+.4f} deg, {size:.4f})"
        f"{stretched}",
    )


def registration_of(moved: Oopao, tel: Oopao, n_subapertures: int) -> Misregistration:
    """Return the registration that OOPAO's ``MisRegistration`` is."""
    # OOPAO moves the mirror by minus the shift.
    shift_m = -np.array([float(moved.shiftX), float(moved.shiftY)])
    return decompose(_linear(moved), shift_m * _steps(tel) * n_subapertures / float(tel.D))


def to_oopao(alpha: Misregistration, tel: Oopao, wfs: Oopao) -> dict[str, float]:
    """Return a registration as OOPAO's ``MisRegistration`` takes it: metres, degrees, fractions."""
    n_subapertures = int(wfs.nSubap) / int(getattr(wfs, "binning", 1))
    subaperture_m = float(tel.D) / n_subapertures / _steps(tel)
    # OOPAO applies the stretch first, then the rotation
    stretch = rotation(alpha.rotation_rad).T @ alpha.image
    # eigh sorts by size: the larger scale is called radial, and the angle is that of its axis.
    (tangential, radial), axes = np.linalg.eigh((stretch + stretch.T) / 2)
    return {
        "rotationAngle": float(np.rad2deg(alpha.rotation_rad)),
        "shiftX": -alpha.shift_x_subap * subaperture_m,
        "shiftY": -alpha.shift_y_subap * subaperture_m,
        "anamorphosisAngle": float(np.rad2deg(np.arctan2(-axes[1, 1], axes[0, 1]))) % 180.0,
        "tangentialScaling": float(tangential) - 1.0,
        "radialScaling": float(radial) - 1.0,
    }


# --- what was saved of its objects


def from_saved(arrays: Mapping[str, Array], where: str) -> Imported:
    """Return what ``np.savez`` kept of OOPAO's objects, by names like ``tel.D``, ``dm.modes``.

    ``calib.D`` and ``M2C`` are taken where they are.

    Raises
    ------
    ConfigurationError, MatrixError
        If something is missing, or is not what it is called.
    """
    objects = {name: SimpleNamespace() for name in SAVED}
    for name, values in arrays.items():
        owner, _, attribute = name.rpartition(".")
        rule = SAVED.get(owner, {}).get(attribute)
        if rule is None:
            continue
        if not rule.fits(values):
            found = values if values.size == 1 else f"{values.dtype} of shape {values.shape}"
            raise ConfigurationError(f"{where}: {name}: found {found}, expected {rule.expected}")
        setattr(objects[owner], attribute, values.item() if rule.single else values)
    kind = getattr(objects["wfs"], "tag", PYRAMID)
    missing = [
        f"{owner}.{attribute}"
        for owner, rules in SAVED.items()
        for attribute, rule in rules.items()
        if rule.needed and rule.sensor in {None, kind} and not hasattr(objects[owner], attribute)
    ]
    if missing:
        raise ConfigurationError(
            f"{where}: found no {', '.join(missing)}; expected it with the others"
        )
    objects["dm"].misReg = objects["dm.misReg"]
    return from_oopao(
        objects["tel"],
        objects["dm"],
        objects["wfs"],
        arrays.get("calib.D"),
        arrays.get("M2C"),
        objects["ngs"],
    )
