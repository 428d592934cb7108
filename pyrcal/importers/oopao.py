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
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pyrcal.importers.imported import Array, Dataset, Imported, matrix_of, orient_matrix
from service.errors import ConfigurationError
from service.model.misregistration import Misregistration, rotation

PYRAMID, LENSLETS = "pyramid", "shackHartmann"

SAVED = {
    "tel": ("D", "resolution", "pupil", "pupilReflectivity"),
    "ngs": ("wavelength",),
    "dm": (
        *("modes", "altitude", "initial_coordinates", "nActAlongDiameter", "mechCoupling"),
        *("sign", "flip_", "flip_lr", "validAct"),
    ),
    "dm.misReg": (
        *("rotationAngle", "shiftX", "shiftY", "anamorphosisAngle"),
        *("radialScaling", "tangentialScaling"),
    ),
    "wfs": (
        *("tag", "nSubap", "modulation", "n_pix_separation", "binning", "postProcessing"),
        *("validI4Q", "valid_subapertures", "pixel_scale", "n_pix_subap", "threshold_cog"),
        "is_geometric",
    ),
}
"""Attributes that are read from each object; missing ones do not apply to that object."""

_OPTIONAL = {
    *("pupilReflectivity", "altitude", "sign", "flip_", "flip_lr", "is_geometric", "validAct"),
}

_OF_SENSOR = {
    **dict.fromkeys(
        ("modulation", "n_pix_separation", "binning", "postProcessing", "validI4Q"), (PYRAMID,)
    ),
    **dict.fromkeys(
        ("valid_subapertures", "pixel_scale", "n_pix_subap", "threshold_cog"), (LENSLETS,)
    ),
}
"""Attributes of ``wfs`` that only one kind of sensor has."""

_WORDS = {"tag", "postProcessing"}
_ARRAYS = {
    **dict.fromkeys(("pupil", "validI4Q", "valid_subapertures"), (2,)),
    "pupilReflectivity": (0, 2),
    "modes": (2, 3),
    "initial_coordinates": (2,),
    "validAct": (1, 2),
}
"""Attributes that are arrays, with the allowed numbers of axes."""

_COUNTS = {
    **dict.fromkeys(("nSubap", "n_pix_subap", "binning"), 1),
    **dict.fromkeys(("resolution", "nActAlongDiameter"), 2),
}
"""Attributes that are counts, with their smallest values."""

_AXES = 2
"""Number of coordinates of a point."""

_POSITIVE = {"D", "wavelength", "mechCoupling", "pixel_scale"}

_MAX_NUMBER = 1e6
"""Largest allowed value of any attribute, in its own unit."""

_MAX_SHAPE_DEVIATION = 1e-3
"""Largest accepted deviation of an influence function from its Gaussian, relative to its height."""

_MAX_ROUNDING = 1e-9
"""Stretches below this are rounding errors."""

_SAMPLED_ACTUATORS = 24
"""Number of influence functions that are compared with the Gaussian."""


def from_oopao(
    tel: Any,  # noqa: ANN401 - OOPAO's own classes, known by their attributes
    dm: Any,  # noqa: ANN401
    wfs: Any,  # noqa: ANN401
    calib: Any = None,  # noqa: ANN401
    M2C: Array | None = None,  # noqa: N803 - OOPAO's own name
    ngs: Any = None,  # noqa: ANN401
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
        strokes, turned = orient_matrix(
            _numpy(M2C), n_actuators, None, "M2C", "(n_actuators, n_modes)"
        )
        notes += turned
        n_modes = strokes.shape[1]
        mirror["mode_to_actuator"] = Dataset("mode_to_actuator")
        arrays["mode_to_actuator"] = strokes
    if calib is not None:
        matrix, turned = matrix_of(_numpy(getattr(calib, "D", calib)), 2 * valid.sum(), n_modes)
        notes += turned
        arrays["interaction_matrix"] = matrix
    arrays |= {"valid_subapertures": valid.astype(np.uint8), "pupil": pupil}
    return Imported(
        source="OOPAO",
        tables={
            "instrument": {
                "name": "oopao",
                "diameter_m": diameter_m,
                "pupil": Dataset("pupil"),
                "stop": "telescope",
                "double_pass": False,
            },
            "wfs": {
                **sensor,
                "wavelength_m": wavelength_m,
                "valid_subapertures": Dataset("valid_subapertures"),
            },
            "mirror": mirror,
            "slopes": slopes,
        },
        arrays=arrays,
        notes=tuple(notes),
    )


def _numpy(values: Any) -> Array:  # noqa: ANN401 - of NumPy or CuPy
    """Return an array of this machine's memory."""
    return np.asarray(values.get() if hasattr(values, "get") else values)


def _wavelength_m(tel: Any, wfs: Any, ngs: Any) -> float:  # noqa: ANN401
    source = ngs or getattr(wfs, "src", None) or getattr(tel, "src", None)
    if source is None or not hasattr(source, "wavelength"):
        raise ConfigurationError(
            "ngs: found no source with a wavelength, expected the sensor's source"
        )
    return float(source.wavelength)


def _pupil(tel: Any) -> NDArray[np.float32]:  # noqa: ANN401
    """Return the share of light of every point: OOPAO's reflectivity is of the intensity."""
    reflectivity = _numpy(getattr(tel, "pupilReflectivity", 1.0))
    return np.asarray(_numpy(tel.pupil) * np.sqrt(reflectivity), dtype=np.float32)


def _lit_pupil(
    tel: Any,  # noqa: ANN401
    sensor: dict[str, Any],
    notes: list[str],
) -> tuple[NDArray[np.float32], float]:
    """Return the pupil without a dark rim, and its diameter; ``sensor`` is changed to match.

    A padded telescope has an array that is wider than its light, and ``tel.D`` is the array's.
    """
    pupil = _pupil(tel)
    side = len(pupil)
    lit = np.argwhere(pupil > 0.0)
    if pupil.ndim != 2 or side != pupil.shape[1] or not len(lit):
        raise ConfigurationError(
            f"tel.pupil: found shape {pupil.shape}, expected light on a square (n, n)"
        )
    rim = int(min(lit.min(), side - 1 - lit.max()))
    if not rim:
        return pupil, float(tel.D)
    share = (side - 2 * rim) / side
    diameter_m = float(tel.D) * share
    sensor["pupil_diameter_subap"] = sensor["n_subapertures"] * share
    if "modulation_lambda_over_d" in sensor:
        sensor["modulation_lambda_over_d"] *= share  # it is counted in wavelengths over tel.D
    notes.append(
        f"tel.D = {float(tel.D):g} m is that of a padded array: a dark rim of {rim} points is cut, "
        f"so that the pupil is {diameter_m:.4g} m wide, {sensor['pupil_diameter_subap']:.4g} of "
        f"{sensor['n_subapertures']} subapertures"
    )
    return pupil[rim : side - rim, rim : side - rim], diameter_m


def _steps(tel: Any) -> float:  # noqa: ANN401
    """Return a length of a pupil that is n samples wide over one of OOPAO's."""
    return (int(tel.resolution) - 1) / int(tel.resolution)


# --- the sensor


def _sensor(
    tel: Any,  # noqa: ANN401
    wfs: Any,  # noqa: ANN401
    notes: list[str],
) -> tuple[dict[str, Any], NDArray[np.bool_], dict[str, Any]]:
    """Return ``[wfs]``, its valid subapertures, and ``[slopes]``."""
    kind = getattr(wfs, "tag", type(wfs).__name__)
    if kind == PYRAMID:
        return _pyramid(tel, wfs, notes)
    if kind == LENSLETS:
        return _lenslets(wfs, notes)
    raise ConfigurationError(f"wfs.tag: found {kind!r}, expected {PYRAMID!r} or {LENSLETS!r}")


def _pyramid(
    tel: Any,  # noqa: ANN401
    wfs: Any,  # noqa: ANN401
    notes: list[str],
) -> tuple[dict[str, Any], NDArray[np.bool_], dict[str, Any]]:
    if not wfs.postProcessing.startswith("slopesMaps"):
        raise ConfigurationError(
            f"wfs.postProcessing: found {wfs.postProcessing!r}, expected 'slopesMaps' or another "
            "one that makes slopes; or give its frames: docs/howto/fitting.md"
        )
    if wfs.postProcessing != "slopesMaps":
        notes.append(
            f"wfs.postProcessing = {wfs.postProcessing!r} normalises by a constant: gains of all "
            "modes differ from 1 alike"
        )
    if getattr(wfs, "user_modulation_path", None) is not None:
        notes.append("wfs.user_modulation_path is taken as a circle of the radius wfs.modulation")
    if getattr(wfs, "rooftop", None) or getattr(wfs, "theta_rotation", 0):
        notes.append("a rooftop, and faces that are turned, are not in pyrcal's model")
    valid, binning = _numpy(wfs.validI4Q).astype(bool), int(wfs.binning)
    sensor = {
        "kind": "pyramid",
        "n_subapertures": len(valid),
        "pupil_separation_subap": (int(wfs.nSubap) + float(wfs.n_pix_separation)) / binning,
        "modulation_lambda_over_d": float(wfs.modulation) / _steps(tel),
    }
    return sensor, valid, {"order": "xy", "orientation": "auto", "normalisation": "global"}


def _lenslets(
    wfs: Any,  # noqa: ANN401
    notes: list[str],
) -> tuple[dict[str, Any], NDArray[np.bool_], dict[str, Any]]:
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


def _functions(tel: Any, dm: Any) -> Array:  # noqa: ANN401
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
    tel: Any,  # noqa: ANN401
    dm: Any,  # noqa: ANN401
    functions: Array,
    notes: list[str],
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
        "influence_functions": Dataset("influence_functions"),
        "modes_pitch_m": float(tel.D) / side,
    }
    return table, {"influence_functions": cube}


def _places(dm: Any, n_functions: int, notes: list[str]) -> Array | None:  # noqa: ANN401
    """Return where the actuators of the functions are drawn; None if that is not known.

    With a scalar ``actuator_selection`` OOPAO drops functions, and leaves the coordinates as they
    were: ``validAct`` lists those that are left.
    """
    places = getattr(dm, "initial_coordinates", None)
    if places is None:
        return None
    places = _numpy(places)
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


def _gaussian(
    tel: Any,  # noqa: ANN401
    dm: Any,  # noqa: ANN401
    places: Array,
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return ``[mirror]`` of OOPAO's own Gaussian mirror at its position without misReg."""
    places = places.astype(float) * _steps(tel) * _flip_signs(dm)
    table = {
        "layout": "positions",
        "positions": Dataset("positions"),
        "pitch_m": float(tel.D) / float(dm.nActAlongDiameter) * _steps(tel),
        "influence": "gaussian",
        "coupling": float(dm.mechCoupling),
    }
    return table, {"positions": places}


def _flip_signs(dm: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """Return the sign of x and y from the flips of OOPAO's influence functions."""
    x, y = (-1.0, -1.0) if getattr(dm, "flip_", False) else (1.0, 1.0)
    return np.array([-x if getattr(dm, "flip_lr", False) else x, y])


def _is_gaussian(
    dm: Any,  # noqa: ANN401
    places: Array,
    functions: Array,
    diameter_m: float,
) -> bool:
    """Return True if the influence functions are the Gaussians given by the attributes."""
    if getattr(dm, "sign", 1) != 1:
        return False
    some = np.unique(np.linspace(0, len(places) - 1, _SAMPLED_ACTUATORS).astype(int))
    drawn = _compute_gaussians(dm, places[some].astype(float), len(functions), diameter_m)
    return bool(np.abs(drawn - functions[:, some].T).max() <= _MAX_SHAPE_DEVIATION)


def _compute_gaussians(dm: Any, places_m: Array, n_points: int, diameter_m: float) -> Array:  # noqa: ANN401
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


def _linear(moved: Any) -> NDArray[np.float64]:  # noqa: ANN401
    """Return what a ``MisRegistration`` does to coordinates, ``(2, 2)``, before its shift."""
    axes = rotation(np.deg2rad(float(moved.anamorphosisAngle)))
    radial, tangential = 1.0 + float(moved.radialScaling), 1.0 + float(moved.tangentialScaling)
    # OOPAO counts the angle of the anamorphosis opposite to its rotation
    stretch = axes.T @ np.diag([radial, tangential]) @ axes
    return np.asarray(rotation(np.deg2rad(float(moved.rotationAngle))) @ stretch)


def _describe_registration(moved: Any, tel: Any, n_subapertures: int) -> tuple[str, ...]:  # noqa: ANN401
    """Return the registration that a mirror has been given, as a note; nothing where none."""
    if np.allclose(_linear(moved), np.eye(2)) and not moved.shiftX and not moved.shiftY:
        return ()
    alpha = registration_of(moved, tel, n_subapertures)
    # a fit has 1 sigma of 0.001 subapertures: two decimals would look like a disagreement
    x, y, turned, size = (round(value, 4) + 0.0 for value in alpha.to_boundary().values())
    stretched = np.abs(alpha.stretches).max() > _MAX_ROUNDING
    text = f", stretched by {alpha.stretches[0]:+.4f}, {alpha.stretches[1]:+.4f}"
    return (
        "α is relative to OOPAO's mirror without its misReg, which is "
        f"α = ({x:+.4f}, {y:+.4f} subap, {turned:+.4f} deg, {size:.4f})"
        f"{text if stretched else ''}",
    )


def registration_of(moved: Any, tel: Any, n_subapertures: int) -> Misregistration:  # noqa: ANN401
    """Return the registration that OOPAO's ``MisRegistration`` is."""
    linear, per_subaperture = _linear(moved), _steps(tel) * n_subapertures / float(tel.D)
    turn = float(np.arctan2(linear[1, 0] - linear[0, 1], np.trace(linear)))
    stretch = linear @ rotation(turn).T
    size = float(np.trace(stretch)) / 2
    return Misregistration(
        shift_x_subap=-float(moved.shiftX) * per_subaperture,
        shift_y_subap=-float(moved.shiftY) * per_subaperture,
        rotation_rad=turn,
        magnification=size,
    ).with_anamorphosis(stretch[0] / size - [1.0, 0.0])


def to_oopao(alpha: Misregistration, tel: Any, wfs: Any) -> dict[str, float]:  # noqa: ANN401
    """Return a registration as OOPAO's ``MisRegistration`` takes it: metres, degrees, fractions."""
    n_subapertures = int(wfs.nSubap) / int(getattr(wfs, "binning", 1))
    subaperture_m = float(tel.D) / n_subapertures / _steps(tel)
    # OOPAO applies the stretch first, then the rotation
    stretch = rotation(alpha.rotation_rad).T @ alpha.image
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
        if owner in objects:
            setattr(
                objects[owner], attribute, _check_attribute(f"{where}: {name}", attribute, values)
            )
    missing = [f"{owner}.{name}" for owner, name in _list_missing(objects)]
    if missing:
        raise ConfigurationError(
            f"{where}: found no {', '.join(missing)}; expected it with the others"
        )
    side = int(objects["tel"].resolution)
    for name in ("pupil", "pupilReflectivity"):
        shape = np.shape(getattr(objects["tel"], name, ()))
        if shape not in {(), (side, side)}:
            raise ConfigurationError(
                f"{where}: tel.{name}: found shape {shape}, expected ({side}, {side}) as "
                "tel.resolution says"
            )
    places = np.shape(objects["dm"].initial_coordinates)
    if places[1] != _AXES:
        raise ConfigurationError(
            f"{where}: dm.initial_coordinates: found shape {places}, expected (n_actuators, 2)"
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


def _check_attribute(where: str, attribute: str, values: Array) -> object:
    """Return an attribute as OOPAO has it: a number, a word, or an array.

    Raises
    ------
    ConfigurationError
        If it is of another kind, has other axes, or is a number that cannot be.
    """
    if attribute in _WORDS:
        word = values.item() if values.size == 1 else values
        if not isinstance(word, str):
            raise ConfigurationError(f"{where}: found {word!r}, expected a word")
        return word
    if attribute in _ARRAYS:
        axes = _ARRAYS[attribute]
        if values.dtype.kind not in "iufb" or values.ndim not in axes or not values.size:
            expected = " or ".join(str(n) for n in axes)
            raise ConfigurationError(
                f"{where}: found {values.dtype} of shape {values.shape}, expected numbers with "
                f"{expected} axes"
            )
        return values
    number = values.item() if values.size == 1 and values.dtype.kind in "iufb" else np.nan
    low = (
        float(_COUNTS.get(attribute, 0))
        if attribute in _COUNTS
        else 0.0
        if attribute in _POSITIVE
        else -_MAX_NUMBER
    )
    if not low <= float(number) <= _MAX_NUMBER or (attribute in _POSITIVE and number == 0.0):
        found = values if values.size == 1 else f"shape {values.shape}"
        raise ConfigurationError(
            f"{where}: found {found}, expected {_describe_expected(attribute)}"
        )
    return number


def _describe_expected(attribute: str) -> str:
    if attribute in _COUNTS:
        return f"a number of at least {_COUNTS[attribute]}"
    return "a number above 0" if attribute in _POSITIVE else "a finite number"


def _list_missing(objects: Mapping[str, SimpleNamespace]) -> Iterator[tuple[str, str]]:
    """Yield what every import needs of each object and was not saved."""
    kind = getattr(objects["wfs"], "tag", PYRAMID)
    for owner, names in SAVED.items():
        for name in names:
            needed = name not in _OPTIONAL and kind in _OF_SENSOR.get(name, (kind,))
            if needed and not hasattr(objects[owner], name):
                yield owner, name
