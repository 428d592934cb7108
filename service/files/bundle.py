"""A calibration as one file: everything that belongs together, with checksums.

Layout (version 1). HDF5: each array a dataset of its name. FITS: each array an image, EXTNAME its
name in capitals. In either the manifest, UTF-8 JSON as bytes, is the array ``manifest``: format,
version, id, what is known of the reconstructor, and for each array its dtype, shape and SHA-256;
``sha256`` of the manifest itself (as written, without that key, keys sorted, no spaces) is its last
word. Numbers are little-endian, and the same in both.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from service.errors import ConfigurationError, MatrixError, StorageError
from service.files.container import opened
from service.files.documents import plain
from service.files.durable import flush
from service.files.whole import write_whole

Array = NDArray[Any]

FORMAT: Final = "pyrcal-bundle"
VERSION: Final = 1
MANIFEST: Final = "manifest"
RECONSTRUCTOR: Final = "reconstructor"

DESCRIBED: Final = {
    RECONSTRUCTOR: "(n_modes, n_slopes) metres of OPD per slope",
    "interaction_matrix": "(n_slopes, n_modes) slope per metre of OPD, at alpha",
    "reference_slopes": "(n_slopes,) what was subtracted from the slopes",
    "reference_offset": "(n_slopes,) what was subtracted beyond these, to hold a shape",
    "optical_gain": "(n_modes,) of each mode when it was made; 1: not measured",
    "gain_factor": "(n_modes,) what multiplies one loop gain of all modes",
    "mode_to_actuator": "(n_actuators, n_modes) strokes of each mode of the basis",
    "covariance": "(4, 4) of shift_x, shift_y in subapertures, rotation in degrees, magnification",
}
"""Arrays that a bundle may have, and what they are; the reconstructor is never missing."""

_FITS_ENDINGS = (".fits", ".fit", ".fts")
_LARGEST_MANIFEST = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle:
    """A reconstructor and all that belongs to it."""

    id: str
    """Id of the reconstructor."""

    arrays: Mapping[str, Array]
    """Arrays by their names in ``DESCRIBED``, float32 or float64."""

    facts: Mapping[str, Any]
    """Metadata that JSON can hold: alpha, sigma, verdict, provenance, parent..."""

    @property
    def sha256(self) -> str:
        """Checksum of the manifest, and so of the whole bundle."""
        return _digest(_manifest(self))


def write_bundle(path: str | Path, bundle: Bundle) -> None:
    """Write a complete bundle, or none: FITS if the name ends so, else HDF5.

    Raises
    ------
    ConfigurationError
        If the file is there already, or FITS is requested and astropy is missing.
    MatrixError
        If an array is unknown, not finite, or of another type than float32 or float64.
    StorageError
        If the disk refuses.
    """
    path = Path(path)
    if path.exists():
        raise ConfigurationError(f"{path}: is there already; a bundle is never overwritten")
    _check(bundle)
    manifest = _manifest(bundle)
    text = json.dumps({**manifest, "sha256": _digest(manifest)}, sort_keys=True).encode()
    arrays = {**bundle.arrays, MANIFEST: np.frombuffer(text, np.uint8)}
    if path.suffix.lower() in _FITS_ENDINGS:
        _write_fits(path, arrays)
        return

    def fill(file: h5py.File) -> None:
        file.attrs["format"] = FORMAT
        for name, values in arrays.items():
            file[name] = _plain(values)
            file[name].attrs["description"] = DESCRIBED.get(name, "JSON")

    write_whole(path, fill)


def read_bundle(path: str | Path) -> Bundle:
    """Return a bundle, every array as it was written.

    Raises
    ------
    MatrixError
        If it is none, of another version, or anything in it is not what was written: the message
        names the array.
    """
    path = Path(path)
    with opened(path) as container:
        # FITS names are in capitals.
        stored = {name.lower(): array for name, array in container.arrays.items()}
        if MANIFEST not in stored:
            raise MatrixError(f"{path}: found {container.listing()}, expected a bundle's manifest")
        manifest = _read_manifest(path, stored.pop(MANIFEST).read())
        arrays = {}
        for name, expected in manifest["arrays"].items():
            if name not in stored:
                raise MatrixError(f"{path}: {name} is missing, which its manifest has")
            # FITS is big-endian: the checksum is of the little-endian numbers.
            values = _plain(stored[name].read())
            found = {"dtype": values.dtype.str, "shape": list(values.shape), **_sum_of(values)}
            if found != expected:
                raise MatrixError(
                    f"{path}: {name} is not as it was written: found {found['dtype']} "
                    f"{found['shape']} {found['sha256'][:12]}, expected {expected.get('dtype')} "
                    f"{expected.get('shape')} {str(expected.get('sha256'))[:12]}"
                )
            arrays[name] = values
        # What the manifest does not name has no checksum.
        others = stored.keys() - arrays.keys()
        if others:
            raise MatrixError(f"{path}: found {', '.join(sorted(others))}, not in its manifest")
    bundle = Bundle(id=manifest["id"], arrays=arrays, facts=manifest["facts"])
    _check(bundle)
    return bundle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Place:
    """A loop that a bundle is to be applied to: what it runs with, and what it has a place for."""

    system: str
    """Name of the instrument."""

    config_id: str
    n_slopes: int
    modes: Array
    """``(n_modes, n_actuators)`` strokes of the loop's basis, in any unit."""

    takes: frozenset[str] = frozenset()
    """Arrays among ``gain_factor`` and ``reference_slopes`` that can be set."""


def why_not(bundle: Bundle, place: Place) -> str:
    """Return why a loop cannot take all of a bundle, what was found and expected; empty: it can.

    Half of a calibration is another loop: what has no place is a reason, unless it changes nothing.
    """
    n_modes, n_slopes = bundle.arrays[RECONSTRUCTOR].shape
    instrument = bundle.facts.get("instrument")
    config_id = (bundle.facts.get("record") or {}).get("config_id")
    if instrument not in {None, place.system}:
        return f"found a bundle of {instrument}, expected one of {place.system}"
    if config_id not in {None, place.config_id}:
        return f"found a bundle of configuration {config_id}, expected {place.config_id}"
    if n_slopes != place.n_slopes or n_modes > len(place.modes):
        found = f"a reconstructor of {n_modes} modes, {n_slopes} slopes"
        return f"found {found}, expected at most {len(place.modes)}, and {place.n_slopes}"
    factors = bundle.arrays.get("gain_factor", np.ones(n_modes))
    if len(factors) < n_modes or factors.min() < 0.0:
        found = f"{len(factors)} gain factors, the least {factors.min():.3g}"
        return f"found {found}, expected {n_modes}, none below 0"
    if not np.all(factors == 1.0) and "gain_factor" not in place.takes:
        return "found gain factors of the modes, expected none: this loop has no place for them"
    reference = bundle.arrays.get("reference_slopes")
    if reference is not None and "reference_slopes" not in place.takes:
        return "found reference slopes, expected none: this loop has no place for them"
    if reference is not None and reference.shape != (n_slopes,):
        return f"found {len(reference)} reference slopes, expected {n_slopes}"
    return _other_basis(bundle.arrays.get("mode_to_actuator"), place.modes[:n_modes])


SAME_MODE = 0.999
"""Least cosine between the strokes of a mode and of the same mode elsewhere."""


def _other_basis(mode_to_actuator: Array | None, modes: Array) -> str:
    """Return which mode is another one; a basis may be in another unit, not of other signs."""
    if mode_to_actuator is None:
        return ""
    theirs = mode_to_actuator.T[: len(modes)].astype(np.float64)
    if theirs.shape != modes.shape:
        found = "modes of {1} actuators".format(*theirs.shape)
        return f"found {len(theirs)} {found}, expected {len(modes)} of {modes.shape[1]}"
    length = np.linalg.norm(theirs, axis=1) * np.linalg.norm(modes, axis=1)
    # A mode without strokes has cosine 0 and is refused, instead of dividing by zero.
    along = np.einsum("ma,ma->m", theirs, modes) / np.where(length > 0.0, length, np.inf)
    k = int(np.argmin(along))
    if along[k] < SAME_MODE:
        return (
            f"found another basis: mode {k} has a cosine of {along[k]:.3f} with the loop's, "
            f"expected {SAME_MODE} or more"
        )
    return ""


def _read_manifest(path: Path, stored: Array) -> dict[str, Any]:
    refused = MatrixError(f"{path}: manifest is not as it was written")
    if stored.ndim != 1 or stored.dtype.itemsize != 1 or len(stored) > _LARGEST_MANIFEST:
        raise refused
    try:
        manifest = json.loads(stored.astype(np.uint8).tobytes())
        checksum = manifest.pop("sha256")
        if manifest["format"] != FORMAT or manifest["version"] != VERSION:
            raise MatrixError(
                f"{path}: found {manifest['format']} of version {manifest['version']}, expected "
                f"{FORMAT} of version {VERSION}"
            )
        arrays = manifest["arrays"]
        whole = all(isinstance(one, dict) for one in (arrays, manifest["facts"], *arrays.values()))
        if not whole or not isinstance(manifest["id"], str) or checksum != _digest(manifest):
            raise refused
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise refused from error
    return dict(manifest)


def _manifest(bundle: Bundle) -> dict[str, Any]:
    arrays = {name: _plain(values) for name, values in bundle.arrays.items()}
    return {
        "format": FORMAT,
        "version": VERSION,
        "id": bundle.id,
        "facts": plain(bundle.facts, finite=False),
        "arrays": {
            name: {"dtype": values.dtype.str, "shape": list(values.shape), **_sum_of(values)}
            for name, values in arrays.items()
        },
    }


def _check(bundle: Bundle) -> None:
    if RECONSTRUCTOR not in bundle.arrays:
        raise MatrixError(f"{bundle.id}: found no reconstructor, which a bundle is made for")
    for name, values in bundle.arrays.items():
        if name not in DESCRIBED:
            raise MatrixError(f"{bundle.id}: found {name}, expected one of {', '.join(DESCRIBED)}")
        n_axes = DESCRIBED[name].partition(")")[0].rstrip(",").count(",") + 1
        if values.dtype.kind != "f" or values.ndim != n_axes or not np.isfinite(values).all():
            raise MatrixError(
                f"{bundle.id}: {name}: found {values.dtype} of shape {values.shape}; expected "
                f"finite numbers {DESCRIBED[name]}"
            )


def _plain(values: Array) -> Array:
    """Return an array as it is summed and written: C order, little-endian."""
    return np.ascontiguousarray(values, values.dtype.newbyteorder("<"))


def _sum_of(values: Array) -> dict[str, str]:
    return {"sha256": hashlib.sha256(values.tobytes()).hexdigest()}


def _digest(manifest: Mapping[str, Any]) -> str:
    text = json.dumps(manifest, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _write_fits(path: Path, arrays: Mapping[str, Array]) -> None:
    try:
        from astropy.io import fits  # takes long to import
    except ImportError as error:
        raise ConfigurationError(
            f"{path}: FITS needs astropy; expected it to be installed: pip install astropy"
        ) from error
    first = fits.PrimaryHDU()
    first.header["FORMAT"] = (FORMAT, "one calibration, all its parts")
    images = [fits.ImageHDU(values, name=name.upper()) for name, values in arrays.items()]
    part = path.with_name(path.name + ".part")
    try:
        fits.HDUList([first, *images]).writeto(part, overwrite=True)
        flush(part)
        os.link(part, path)  # never over another file
        flush(path.parent)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error}") from error
    finally:
        part.unlink(missing_ok=True)
