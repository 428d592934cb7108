"""The figures of the tutorials."""

from __future__ import annotations

from collections.abc import Callable

from matplotlib.figure import Figure

FIGURES: dict[str, Callable[[], Figure]] = {}
