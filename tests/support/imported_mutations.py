"""Files of OOPAO, SPECULA and SynIM, and ways to get them wrong, each with what must become of it.

``pyrcal/samples/data`` holds what OOPAO 1.0.0 and SPECULA 1.1.0 saved of their pyramids, and a
matrix of SynIM 2.0.0 for 8 x 8 lenslets in SPECULA's files, whose mirror lies at +0.25, -0.1
subapertures and is turned by 1 degree.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from astropy.io import fits

from pyrcal.importers.files import Reported
from pyrcal.importers.imported import Imported
from pyrcal.importers.oopao import from_saved
from pyrcal.importers.saved import read_npz
from pyrcal.importers.specula import from_specula
from service.model.kinds import SlopeOrder
from service.model.slopes import Orientation
from tests.support.repository import ROOT

DATA = ROOT / "pyrcal" / "samples" / "data"

REFUSED, MENDED = "refused", "mended and said"
"""What may become of a mutation beside a broken rule: an error of one line; the good import with a
note more."""


@dataclass(frozen=True, kw_only=True)
class Peer:
    """A code, its good files, and what its user would write into the instrument file."""

    read: Callable[[], dict[str, Any]]
    """Returns the arrays and keywords of the good files by name."""

    to_import: Callable[[dict[str, Any], Any], Imported]
    """Imports them, written into a folder where need be."""

    order: SlopeOrder
    orientation: Orientation
    matrix: str
    """Name of the interaction matrix among the arrays."""


@cache
def _saved() -> dict[str, Any]:
    return read_npz(DATA / "oopao-pyramid.npz")


@cache
def _fits(source: str, places: str) -> dict[str, Any]:
    found: dict[str, Any] = {"places": places}
    for name in ("im", places, "ifunc"):
        with fits.open(DATA / f"{source}-{name}.fits") as file:
            for k, hdu in enumerate(file):
                found[f"{name}{k}"] = None if hdu.data is None else np.array(hdu.data)
            found[f"{name}header"] = dict(file[0].header)
    return found


def _written(source: str, reported: Reported):
    def to_import(given: dict[str, Any], folder) -> Imported:
        paths = []
        for name in ("im", given["places"], "ifunc", "m2c"):
            if f"{name}0" not in given:
                continue
            header = {k: v for k, v in given[f"{name}header"].items() if k in _KEPT}
            units = [fits.PrimaryHDU(given[f"{name}0"], header=fits.Header(header))]
            named = _NAMES.get(name, ("",) * 4)
            units += [
                fits.ImageHDU(given[f"{name}{k}"], name=named[k - 1])
                for k in (1, 2, 3, 4)
                if f"{name}{k}" in given
            ]
            paths.append(folder / f"{name}.fits")
            fits.HDUList(units).writeto(paths[-1], overwrite=True)
        return from_specula(paths, reported, source)

    return to_import


_KEPT = {"VERSION", "FSIZEX", "FSIZEY", "NP_SUB", "NX", "NY", "ENRGYTH", "INTRLVD"}
_NAMES = {"im": ("INTMAT",), "ifunc": ("INFLUENCE_FUNCTION", "MASK_INF_FUNC")}

PEERS = {
    "oopao": Peer(
        read=_saved,
        to_import=lambda given, _: from_saved(given, "it"),
        order=SlopeOrder.XY,
        orientation=Orientation(sign_x=-1, sign_y=-1),
        matrix="calib.D",
    ),
    "specula": Peer(
        read=lambda: _fits("specula", "pup"),
        to_import=_written(
            "SPECULA",
            Reported(
                diameter_m=2.0,
                sensor="pyramid",
                stop="mirror",
                obscuration_ratio=0.2,
                wavelength_m=750e-9,
                modulation_lambda_over_d=3.0,
                unit="nm",
            ),
        ),
        order=SlopeOrder.YX,
        orientation=Orientation(),
        matrix="im1",
    ),
    "synim": Peer(
        read=lambda: _fits("synim", "subap"),
        to_import=_written(
            "SynIM",
            Reported(
                diameter_m=2.0,
                sensor="shack-hartmann",
                stop="telescope",
                obscuration_ratio=0.2,
                wavelength_m=600e-9,
                centroid="gradient",
                unit="nm",
            ),
        ),
        order=SlopeOrder.YX,
        orientation=Orientation(swap_xy=True),
        matrix="im1",
    ),
}


def _with(name, change):
    return lambda given, _peer: {**given, name: change(given[name])}


def _of_matrix(change):
    return lambda given, peer: {**given, peer.matrix: change(given[peer.matrix])}


def _halves(first, second):
    return _of_matrix(
        lambda m: np.concatenate([first * m[: len(m) // 2], second * m[len(m) // 2 :]])
    )


def _interleaved(m):
    return np.stack(np.split(m, 2), axis=1).reshape(m.shape)


def _reversed_subapertures(m):
    return np.concatenate([half[::-1] for half in np.split(m, 2)])


def _swapped(a, b):
    def change(values):
        order = np.arange(values.shape[-1])
        order[[a, b]] = b, a
        return values[..., order]

    return change


def _one_negated(values):
    return values * np.where(np.arange(values.shape[-1]) == 4, -1.0, 1.0)


def _header(name, **keys):
    return _with(f"{name}header", lambda header: {**header, **keys})


def _transposed_map(values, n):
    """Indices into ``(n, n)`` with rows and columns exchanged."""
    return values % n * n + values // n


def _upside_down(values, n):
    return (n - 1 - values // n) * n + values % n


ALL = {
    "all signs": (_halves(-1, -1), {11}),
    "sign of the first half": (_halves(-1, 1), {11}),
    "sign of the second half": (_halves(1, -1), {11}),
    "halves exchanged": (_of_matrix(lambda m: np.concatenate(np.split(m, 2)[::-1])), {10}),
    "interleaved and not said": (_of_matrix(_interleaved), {10}),
    "subapertures from the last": (_of_matrix(_reversed_subapertures), {1, 2, 10, 11}),
    "subapertures rolled": (
        _of_matrix(lambda m: np.concatenate([np.roll(h, 3, axis=0) for h in np.split(m, 2)])),
        {10, 13},
    ),
    "transposed": (_of_matrix(lambda m: m.T.copy()), {MENDED}),
    "a slope is missing": (_of_matrix(lambda m: m[1:]), {REFUSED}),
    "a slope is not a number": (_of_matrix(lambda m: np.where(m == m.max(), np.nan, m)), {REFUSED}),
    "modes reversed": (_of_matrix(lambda m: m[:, ::-1].copy()), {1, 9, 13}),
    "two modes exchanged": (_of_matrix(_swapped(2, 7)), {9}),
    "one mode of the other sign": (_of_matrix(_one_negated), {9}),
}
"""Of any matrix: a pyramid's and a Shack-Hartmann's; another importer hands on the same matrix."""

UNIT = {
    "in another unit, 1e9": (_of_matrix(lambda m: m * 1e9), {13}),
    "in another unit, 1e-3": (_of_matrix(lambda m: m * 1e-3), {13}),
    "of both passes": (_of_matrix(lambda m: m * 2), {15}),
}
"""Of matrices whose unit is known: that of lenslets' slopes is not in SPECULA's files."""

SLOW = {
    *((peer, "subapertures rolled") for peer in ("oopao", "synim")),
    *((peer, "interleaved and not said") for peer in ("oopao", "synim")),
    *((peer, "two modes exchanged") for peer in ("oopao", "synim")),
    *((peer, "said to be interleaved") for peer in ("specula", "synim")),
    *((peer, "functions of other modes") for peer in ("specula", "synim")),
    ("oopao", "modes reversed"),
    ("oopao", "modes to commands of other modes"),
    ("specula", "another width of the detector"),
    ("synim", "another width of the grid"),
}
"""Their fits take long: no start is near."""

OF = {
    "oopao": {
        **ALL,
        **UNIT,
        "modes to commands transposed": (_with("M2C", lambda m: m.T), {MENDED}),
        "modes to commands of other modes": (_with("M2C", _swapped(2, 7)), {9}),
        "modes to commands in nanometres": (_with("M2C", lambda m: m * 1e9), {9, 13}),
        "an actuator is missing": (_with("M2C", lambda m: m[1:]), {REFUSED}),
        "functions transposed": (_with("dm.modes", lambda m: m.T), {REFUSED}),
        "wavelength in nanometres": (_with("ngs.wavelength", lambda v: v * 1e9), {REFUSED}),
        "telescope in millimetres": (_with("tel.D", lambda v: v * 1e3), {REFUSED}),
        "another sensor": (_with("wfs.tag", lambda _: np.array("bioEdge")), {REFUSED}),
        "another kind of signal": (
            _with("wfs.postProcessing", lambda _: np.array("fullFrame")),
            {REFUSED},
        ),
        "actuators in another order": (
            _with("dm.modes", lambda m: m[:, ::-1].copy()),
            {1, 2, 9, 10, 13},
        ),
    },
    "specula": {
        "said to be interleaved": (_header("im", INTRLVD=True), {10}),
        "places by columns": (_with("pup1", lambda v: _transposed_map(v, 40)), {1, 2, 10}),
        "places from below": (_with("pup1", lambda v: _upside_down(v, 40)), {1, 2, 10, 11}),
        "another width of the detector": (_header("pup", FSIZEX=41, FSIZEY=41), {REFUSED, 10, 13}),
        "a place twice": (
            _with("pup1", lambda v: np.where(v == v[3], v[2], v)),
            {REFUSED},
        ),
        "a place is missing": (_with("pup1", lambda v: v[1:]), {REFUSED}),
        "functions of other modes": (_with("ifunc1", lambda v: v[:, ::-1].copy()), {9, 13}),
        "functions transposed": (_with("ifunc1", lambda v: v.T.copy()), {MENDED}),
        "the functions' pupil is another": (
            _with("ifunc2", lambda v: np.where(np.cumsum(v).reshape(v.shape) == 1, 0, v)),
            {REFUSED},
        ),
        "functions from below": (
            _with("ifunc1", lambda v: v[::-1].copy()),
            {1, 2, 9, 10, 11},
        ),
    },
    "synim": {
        **ALL,
        "said to be interleaved": (_header("im", INTRLVD=True), {10}),
        "places by columns": (_with("subap2", lambda v: _transposed_map(v, 8)), {1, 2, 10}),
        "places from below": (_with("subap2", lambda v: _upside_down(v, 8)), {1, 2, 10, 11}),
        "another width of the grid": (_header("subap", NX=9, NY=9), {REFUSED, 10, 13}),
        "a place twice": (_with("subap2", lambda v: np.where(v == v[3], v[2], v)), {REFUSED}),
        "a place is missing": (_with("subap2", lambda v: v[1:]), {REFUSED}),
        "functions of other modes": (_with("ifunc1", _swapped(2, 7)), {9}),
        "functions transposed": (_with("ifunc1", lambda v: v.T.copy()), {MENDED}),
        "functions from below": (_with("ifunc1", lambda v: v[::-1].copy()), {1, 2, 9, 10, 11}),
    },
}
"""By peer and words: what is changed, and what must become of it: one of these at least."""
