"""A fit and its inputs as JSON, as HDF5."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.fitted import Fit, Registration
from pyrcal.fitting.instrument_checks import NOTABLE_CHANGE, NOTABLE_SIGMA
from pyrcal.fitting.left_over import ResidualLocation
from service.control.gains import CalibrationGains
from service.control.reconstructor import Inversion, Recipe
from service.errors import MatrixError
from service.files.container import put_array, put_covariance
from service.files.documents import json_text, pick, plain
from service.files.whole import open_hdf5
from service.model.kinds import Method, SlopeOrder
from service.model.misregistration import (
    BOUNDARY_SCALE,
    COVARIANCE_SCALE,
    PARAMETERS,
    Misregistration,
)
from service.model.slopes import FLIPS, Orientation
from service.version import software_version


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitReport:
    """A fit with its files and instrument."""

    fit: Fit
    method: Method
    instrument: str
    """Name of the instrument."""

    instrument_sha256: str
    """SHA-256 of the instrument's description, arrays included."""

    reference: str
    """File and array that were fitted."""

    reference_sha256: str
    """SHA-256 of the whole file."""

    double_pass: bool
    """True if the matrix was taken as twice the model's."""

    seconds: float
    """Duration of the fit, optical model included and reading excluded, seconds."""

    notes: tuple[str, ...] = ()
    """Notes on decisions of the fit, one sentence each."""


def document(report: FitReport) -> dict[str, Any]:
    """Return the fit as one JSON object in boundary units; numbers that are not finite are None.

    ``gains`` belong to the modes used, in the order of the basis. ``verdict`` begins with
    "accepted" or "refused" and names what was left out.
    """
    fit = report.fit
    found: dict[str, Any] = {
        **fit.alpha.to_boundary(),
        "sigma": _parameters(fit.sigma),
        "covariance": fit.covariance * COVARIANCE_SCALE,
        **pick(fit, "gains residual_fraction condition_number"),
        "n_modes_used": len(fit.modes),
        "orientation": orientation_words(fit.orientation, fit.order),
        "subset_scatter": _parameters(fit.subset_scatter),
        **pick(fit, "converged verdict=verdict_line"),
        "registration": None if fit.registration is None else _registration(fit.registration),
        "reconstructor": None if fit.reconstructor is None else pick(fit.reconstructor, _CONTROL),
        **pick(fit, "anamorphosis anamorphosis_sigma image_offsets_px"),
        "instrument_found": {
            one.key if one.found is not None else _WIDTH: {
                "found": one.found if one.found is not None else np.exp(one.change),
                **pick(one, "sigma=found_sigma told=reported"),
            }
            for one in fit.optics
        },
        "recommendation": fit.recommendation,
        "corrections": dict(fit.corrections),
        "found_not_told": [pick(one, "key found told=reported how correct") for one in fit.origins],
        "unknown_not_found": fit.unknown_not_found,
        "alternatives": [_alternative(one, fit) for one in fit.alternatives],
        "left_over": None if fit.left_over is None else _left_over(fit.left_over),
        "stroke": None
        if fit.stroke is None
        else pick(fit.stroke, "metres_per_unit sigma condition"),
        "causes": [pick(one, "words share sigma remedy") for one in fit.causes],
        "notes": report.notes,
        "seconds": round(report.seconds, 3),
    }
    document: dict[str, Any] = plain(found)
    return document


_CONTROL = (
    "stable_modes n_modes gain pole_radius pole_radius_all aligned_pole_radius "
    "wavefront_ratio=loss_ratio noise_limited weakest_modes reason"
)


def _registration(found: Registration) -> dict[str, Any]:
    distortion = found.distortion
    return {
        **pick(found, "determined reason"),
        "sigma_statistical": _parameters(found.sigma_statistical),
        "sigma_systematic": _parameters(found.sigma_systematic),
        "disjoint_sets": [
            {
                "of": one.words,
                "steps": [_parameters(step) for step in one.steps],
                "sigma": [_parameters(sigma) for sigma in one.sigma],
                "tension": _by_parameter(one.tension),
                "tension_without_distortion": _by_parameter(one.straight_tension),
                "in_sigma": one.even,
            }
            for one in found.sets
        ],
        "distortion_rms_subap": None if distortion is None else distortion.rms_subap,
    }


def _alternative(one: Alternative, fit: Fit) -> dict[str, Any]:
    return {
        **pick(one, "words misfit=share"),
        "moved": _parameters(one.moved),
        "moved_sigma": _by_parameter(one.moved / fit.sigma),
        **pick(one, "preferred undecided"),
        "key": one.key or None,
        "in_sigma": one.weight(fit.residual_fraction),
    }


def _left_over(left: ResidualLocation) -> dict[str, Any]:
    return {
        "border": left.border,
        "subapertures": [
            {"row": y, "column": x, "share": share} for y, x, share in left.subapertures
        ],
        "modes": [{"mode": mode, "share": share} for mode, share in left.modes],
        "arms": [pick(arm, "angle_deg offset_subap excess") for arm in left.arms],
        **pick(left, "planes gradient"),
    }


def orientation_words(orientation: Orientation, order: SlopeOrder) -> dict[str, Any]:
    """Return order and orientation in the notation of the instrument file."""
    both = [orientation.sign_x, orientation.sign_y]
    flips = {name: getattr(orientation, name) for name in FLIPS}
    return {"order": str(order), **flips, "sign": both[0] if both[0] == both[1] else both}


def _parameters(values: NDArray[np.float64]) -> dict[str, float]:
    return _by_parameter(values * BOUNDARY_SCALE)


def _by_parameter(values: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip(PARAMETERS, values, strict=True))


_WIDTH = "influence_width"
"""Name of the fitted width of influence functions without a coupling; not a key of instrument
files."""

# --- as an HDF5 file


_DESCRIPTIONS = {
    "subset_scatter": "(4,) 1 sigma scatter of disjoint sets of modes, in the same units",
    "modes": "(n_used,) basis index of each column",
    "gains": "(n_used,) measured column over the model's, passes divided out",
    "residual_by_mode": "(n_used,) rms left over, as a fraction of the mode's own",
    "residual_map": "(n_planes, n, n) [x or y, or image] rms left over, over the measured",
    "synthetic": "(n_slopes, n_used) the model, slope per metre OPD, axes of conventions",
    "measured": "(n_slopes, n_used) the reference in the same axes and unit",
    "valid": "(n, n) [row, column] subapertures the slopes belong to",
    "gain_map": "(n, n) gain over the pupil common to all modes",
    "anamorphosis": "(2,) stretch along x over the mean of both axes, less 1, and along 45 deg",
    "anamorphosis_sigma": "(2,) 1 sigma of it",
}


def fill_fit(file: h5py.File, report: FitReport) -> None:
    """Write a fit into an open, empty HDF5 file.

    The JSON document is the attribute ``document``; arrays that JSON cannot hold are datasets.
    """
    fit = report.fit
    put_covariance(file, fit.covariance)
    _put_alternatives(file, fit)
    arrays = {name: getattr(fit, name) for name in _DESCRIPTIONS}
    arrays["subset_scatter"] = fit.subset_scatter * BOUNDARY_SCALE
    for name, values in arrays.items():
        if values is not None:
            put_array(file, name, values, _DESCRIPTIONS[name])
    for step, scan in enumerate(fit.paper_table or ()):
        group = file.create_group(f"paper_table/{step:02d}")
        group.attrs.update(parameter=scan.parameter, step=scan.step, minimum=scan.minimum)
        group["samples"], group["chi"] = scan.samples, scan.chi
    file.attrs.update(fit.alpha.to_boundary())
    file.attrs.update(_provenance(report))
    file.attrs["document"] = json_text(document(report))


def _put_alternatives(file: h5py.File, fit: Fit) -> None:
    """Write the alternatives; their descriptions as an attribute in the same order."""
    if not fit.alternatives:
        return
    group = file.create_group("alternatives")
    group.attrs["words"] = [one.words for one in fit.alternatives]
    moved = np.array([one.moved for one in fit.alternatives]) * BOUNDARY_SCALE
    misfit = [np.nan if one.share is None else one.share for one in fit.alternatives]
    put_array(group, "moved", moved, f"(n, 4) move of {', '.join(PARAMETERS)} under each")
    put_array(
        group, "misfit", np.array(misfit), "(n,) chi squared over the fit's; NaN: not comparable"
    )
    put_array(
        group,
        "preferred",
        np.array([one.preferred for one in fit.alternatives]),
        "(n,) whether the matrix is explained better",
    )


def _provenance(report: FitReport) -> dict[str, Any]:
    """Return the origin of a fit as HDF5 attributes."""
    return {
        "instrument": report.instrument,
        "instrument_sha256": report.instrument_sha256,
        "reference": report.reference,
        "reference_sha256": report.reference_sha256,
        "double_pass": report.double_pass,
        "method": str(report.method),
        "verdict": report.fit.verdict,
        "recommendation": report.fit.recommendation,
        "accepted": report.fit.accepted,
        "notes": "\n".join(report.notes),
        **_made_now(),
    }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownFit:
    """The part of an earlier fit that a reconstructor needs."""

    alpha: Misregistration
    covariance: NDArray[np.float64] | None = None
    """``(4, 4)`` covariance of ``alpha.vector``; None if only α is known."""

    modes: NDArray[np.intp] | None = None
    """``(n_used,)`` basis indices that ``gains`` belong to; None if not in the file."""

    gains: NDArray[np.float64] | None = None
    """``(n_used,)`` calibration gains."""

    orientation: Orientation | None = None
    """Orientation of the slopes found by the fit; None if not in the file."""

    order: SlopeOrder | None = None
    """Order of the slope components; None if not in the file."""

    double_pass: bool | None = None
    """True if light was reflected by the mirror twice in the measured matrix; None if not in the
    file."""

    accepted: bool | None = None
    """True if the registration is determined; None if α was given by hand."""

    stable_modes: int | None = None
    """Largest number of modes with which the model's reconstructor is stable on the measured
    matrix; None if not in the file."""

    stable_gain: float | None = None
    """Integrator gain of that loop."""

    origin: str = "given by hand"
    """Source of this fit."""

    instrument_sha256: str | None = None
    """SHA-256 of the instrument it was fitted for; None if not in the file."""

    reference_sha256: str | None = None
    """SHA-256 of the measured file; None if not in the file."""

    instrument_found: Mapping[str, float] = field(default_factory=dict)
    """Fitted values by key that differ from the instrument file or are missing from it."""

    image_offsets_px: NDArray[np.float64] | None = None
    """``(4, 2)`` fitted displacements of the pupil images in the notation of the instrument file;
    None if the file states them, or the sensor has one image."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Provenance:
    """Complete inputs of a reconstructor, from which it can be reproduced."""

    recipe: Recipe
    inversion: Inversion
    fit: KnownFit
    """Registration of its synthetic matrix, and the measured matrix that was fitted."""

    gains: CalibrationGains | None
    """Gains multiplied into the columns; None for the model's own."""

    measured_illumination: bool
    """True if the model's pupil has the illumination of the flux map."""

    def attributes(self) -> dict[str, str | int | float | bool]:
        """Return everything as named scalars, for file attributes and JSON."""
        fit, prior = self.fit, self.recipe.prior
        found: dict[str, str | int | float | bool] = {
            "source": "synthetic",
            "method": str(self.recipe.method),
            "n_modes": self.recipe.n_modes,
            "condition_number": self.inversion.condition_number,
            "n_truncated": self.inversion.n_truncated,
            "single_pass": True,
            "measured_illumination": self.measured_illumination,
            **fit.alpha.to_boundary(),
        }
        if prior is None:
            found["max_condition"] = self.recipe.max_condition
        else:
            found["prior_n_modes"] = len(prior.variance_m2)
            found["prior_wavefront_m"] = float(np.sqrt(prior.variance_m2.sum()))
            found["prior_slope_noise"] = float(np.sqrt(np.mean(np.square(prior.slope_noise))))
        if fit.covariance is not None:
            sigma = np.sqrt(np.diag(fit.covariance)) * BOUNDARY_SCALE
            found |= {f"sigma_{name}": float(s) for name, s in zip(PARAMETERS, sigma, strict=True)}
        if fit.reference_sha256 is not None:
            found["reference_sha256"] = fit.reference_sha256
        if fit.double_pass is not None:
            found["reference_passes"] = 1 + fit.double_pass
        if self.gains is not None:
            controlled = self.gains.measured[: self.recipe.n_modes]
            found["n_gains_measured"] = int(controlled.sum())
            found["n_gains_extended"] = int((~controlled).sum())
        return found


def read_fit(path: str | Path) -> KnownFit:
    """Return the fit in a file that ``pyrcal fit`` wrote: its JSON document, or its product.

    Raises
    ------
    MatrixError
        If it is neither.
    """
    path = Path(path)
    try:
        if h5py.is_hdf5(path):
            with open_hdf5(path) as file:
                return _of_product(file, path)
        return _of_document(json.loads(path.read_text(encoding="utf-8")), path)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise MatrixError(
            f"{path}: {error!r}; expected what pyrcal fit wrote with --json or --output"
        ) from error


def _of_document(values: dict[str, Any], path: Path) -> KnownFit:
    words = values["orientation"]
    sign = words["sign"]
    sign_x, sign_y = sign if isinstance(sign, list) else (sign, sign)
    alpha = Misregistration.from_boundary(values)
    if values.get("anamorphosis") is not None:
        alpha = alpha.with_anamorphosis(_numbers(values["anamorphosis"], "anamorphosis", (2,)))
    return KnownFit(
        alpha=alpha,
        covariance=_numbers(values["covariance"], "covariance", (4, 4)) / COVARIANCE_SCALE,
        orientation=Orientation(
            **{name: words[name] for name in FLIPS}, sign_x=sign_x, sign_y=sign_y
        ),
        order=SlopeOrder(words["order"]),
        accepted=str(values["verdict"]).startswith("accepted"),
        **_control(values.get("reconstructor")),
        instrument_found=_otherwise(values.get("instrument_found", {})),
        image_offsets_px=None
        if values.get("image_offsets_px") is None
        else _numbers(values["image_offsets_px"], "image_offsets_px", (4, 2)),
        origin=str(path),
    )


def _numbers(values: ArrayLike, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return finite numbers of a fit's file; ValueError if they are not, or of another shape."""
    found = np.asarray(values, dtype=np.float64)
    if found.shape != shape:
        raise ValueError(f"{name}: found shape {found.shape}, expected {shape}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: found NaN or infinity, expected numbers")
    return found


def _control(found: dict[str, Any] | None) -> dict[str, Any]:
    """Return the closed-loop result of a file; empty if it has none."""
    if found is None:
        return {}
    return {
        # stable with all fitted modes: the limit is unknown, more may be stable as well
        "stable_modes": None
        if found["stable_modes"] >= found["n_modes"]
        else int(found["stable_modes"]),
        "stable_gain": float(found["gain"]),
    }


def _otherwise(found: dict[str, dict[str, float | None]]) -> dict[str, float]:
    """Return fitted values that differ from the instrument file's."""
    otherwise = {}
    for key, one in found.items():
        value, stated, sigma = one["found"], one["told"], one["sigma"] or 0.0
        if value is None or key == _WIDTH:
            continue
        if stated is None or abs(value - stated) > max(
            NOTABLE_CHANGE * stated, NOTABLE_SIGMA * sigma
        ):
            otherwise[key] = value
    return otherwise


def _of_product(file: h5py.File, path: Path) -> KnownFit:
    fit = _of_document(json.loads(file.attrs["document"]), path)
    gains = file["gains"][()]
    n_used = np.size(gains)
    numbers = _numbers(file["modes"][()], "modes", (n_used,))
    with np.errstate(invalid="ignore"):  # a number beyond the range of integers differs as well
        modes = numbers.astype(np.intp)
    if not np.array_equal(modes, numbers):
        raise ValueError("modes: found a number that is not whole, expected indices of modes")
    return replace(
        fit,
        modes=modes,
        gains=_numbers(gains, "gains", (n_used,)),
        double_pass=bool(file.attrs["double_pass"]),
        accepted=bool(file.attrs["accepted"]),
        instrument_sha256=str(file.attrs["instrument_sha256"]),
        reference_sha256=str(file.attrs["reference_sha256"]),
    )


def fill_reconstructor(
    file: h5py.File,
    interaction_matrix: NDArray[np.float32],
    provenance: Provenance,
    circumstances: Mapping[str, str | int | float | bool],
) -> None:
    """Write a reconstructor and its inputs into an open, empty HDF5 file.

    Parameters
    ----------
    file
        File to fill.
    interaction_matrix
        ``(n_slopes, n_modes)`` matrix that is inverted, slopes in the order of the RTC.
    provenance
        Inputs and results of the inversion.
    circumstances
        Further attributes: instrument, model, orientation.
    """
    described = "slopes as the RTC lists them, single pass"
    for name, values, shape in (
        ("reconstructor", provenance.inversion.matrix, "(n_modes, n_slopes), metres OPD per slope"),
        ("interaction_matrix", interaction_matrix, "(n_slopes, n_modes), slope per metre OPD"),
    ):
        put_array(file, name, np.ascontiguousarray(values, dtype="<f4"), f"{shape}, {described}")
    if provenance.fit.covariance is not None:
        put_covariance(file, provenance.fit.covariance)
    if provenance.gains is not None:
        n_modes = provenance.recipe.n_modes
        file["calibration_gains"] = provenance.gains.values[:n_modes]
        file["calibration_gains"].attrs["measured"] = provenance.gains.measured[:n_modes]
    file.attrs.update({**circumstances, **provenance.attributes(), **_made_now()})


def _made_now() -> dict[str, str]:
    return {
        "software": f"pyrcal {software_version()}",
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
