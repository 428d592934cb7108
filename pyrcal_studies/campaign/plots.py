"""Errors of a campaign against what was said of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from pyrcal_studies.campaign.rows import Row
from pyrcal_studies.campaign.summary import distances, model_errors

LABELS = ("shift x, subap", "shift y, subap", "rotation, deg", "magnification")


def plot(path: Path, rows: list[Row], floor: NDArray[np.float64]) -> None:
    """Draw every parameter's error with its 2 σ, and the distribution of normalised squares."""
    import matplotlib.pyplot as plt

    good = [row for row in rows if row["refused"] is None]
    errors = np.array([row["error"] for row in good])
    covariances = np.array([row["covariance"] for row in good]) + model_errors(good)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2) + floor**2)
    figure, axes = plt.subplots(5, 1, figsize=(9, 11), layout="constrained")
    order = np.lexsort((np.arange(len(good)), [row["magnitude"] for row in good]))
    for axis, label, error, width in zip(
        axes[:4], LABELS, errors[order].T, sigma[order].T, strict=True
    ):
        axis.errorbar(np.arange(len(error)), error, 2 * width, fmt=".", elinewidth=0.6)
        axis.axhline(0.0, color="k", linewidth=0.8)
        axis.set_ylabel(label)
    axes[3].set_xlabel("window, by magnitude; bars are 2 σ, model error included")
    squares = np.sort(distances(errors, covariances, floor))
    share = np.arange(1, len(squares) + 1) / len(squares)
    axes[4].plot(squares, share, drawstyle="steps-post", label="found")
    axes[4].plot(
        squares, scipy.stats.chi2.cdf(squares, 4), label="chi-squared, 4 degrees of freedom"
    )
    axes[4].set(xlabel="normalised squared error", ylabel="share below")
    axes[4].legend()
    figure.savefig(path, dpi=120)
