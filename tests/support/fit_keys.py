"""What tests of several modules share of unit.fitting.test_report."""

from __future__ import annotations

from service.model.misregistration import PARAMETERS

KEYS = {
    *PARAMETERS,
    "sigma",
    "covariance",
    "gains",
    "residual_fraction",
    "condition_number",
    "n_modes_used",
    "orientation",
    "subset_scatter",
    "converged",
    "verdict",
    "registration",
    "reconstructor",
    "notes",
    "recommendation",
    "corrections",
    "found_not_told",
    "unknown_not_found",
    "alternatives",
    "left_over",
    "causes",
    "stroke",
    "anamorphosis",
    "anamorphosis_sigma",
    "image_offsets_px",
    "instrument_found",
    "seconds",
}
