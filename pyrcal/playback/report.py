"""Results of the estimators from telemetry, as a table, as one document, as HDF5, as a plot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from pyrcal.fitting.figures import new_figure
from pyrcal.importers.registration import Dated
from pyrcal.terminal import table as aligned
from service.estimation.random_dither import NoisyMatrix
from service.files.container import put_array
from service.files.documents import pick, plain
from service.model.misregistration import (
    BOUNDARY_SCALE,
    COVARIANCE_SCALE,
    PARAMETERS,
    at_boundary,
    wrap_angle,
)
from service.records import alarms
from service.records.registration import HistoryEntry, PassiveState, Source
from service.records.state import Level, LogEntry, TrackerState
from service.tracking.policy import SECOND_NS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_TEXT = h5py.string_dtype()

FORMAT = "pyrcal-track"
VERSION = 1

DIGITS = (4, 4, 4, 5)
UNITS = ("subaperture", "subaperture", "degree", "")

MIN_WINDOWS = 5
"""Smallest number of windows for which the scatter is reported."""

_COLOURS = {Source.PASSIVE: "0.8", Source.RANDOM: "tab:green", Source.LOCK_IN: "tab:blue"}
"""Colours by source; later ones are plotted on top."""

_OF_MISALIGNED = frozenset(
    {alarms.MODES_CONTRARY, alarms.MODES_UNEVEN, alarms.WRONG_ANSWER, "window.refused"}
)
"""Alarms and warnings that misaligned streams alone can cause."""

_MAX_REASONS = 8
"""Number of kinds of refusals and warnings listed in the table."""


@dataclass(slots=True, kw_only=True)
class Track:
    """Results of the estimators from telemetry."""

    entries: list[HistoryEntry] = field(default_factory=list)
    """Measurements of α, in the order in which they were processed."""

    passive: list[PassiveState] = field(default_factory=list)
    """Estimates of α from ordinary telemetry alone, each with its bias included."""

    lines: list[LogEntry] = field(default_factory=list)
    """Log entries of the tracker."""

    noisy: NoisyMatrix | None = None
    """Interaction matrix from the last random dither; None if there was none."""

    stated: tuple[Dated, ...] = ()
    """α from the file itself, in its order; only AOT files have it."""

    misaligned: str = ""
    """Measured offset between slopes and commands; empty if it is as stated or not measurable."""

    n_frames: int = 0
    """Number of frames used."""

    n_missing: int = 0
    """Number of frames missing between these, from their sequence numbers."""

    n_gaps: int = 0
    """Number of gaps."""

    first_ns_utc: int = 0
    last_ns_utc: int = 0
    """End of the last used frame, the RTC's clock; ``first_ns_utc`` is that of the first."""

    state: TrackerState
    """State of the tracker at the end."""

    @property
    def t(self) -> NDArray[np.float64]:
        """``(n,)`` end of each measurement of α, seconds since the first frame."""
        ends_ns = np.array([entry.t_ns_utc for entry in self.entries], np.int64)
        return (ends_ns - self.first_ns_utc) / SECOND_NS

    @property
    def alpha(self) -> NDArray[np.float64]:
        """``(n, 4)`` filtered α after each measurement, in the units of ``PARAMETERS``."""
        return to_boundary([entry.filtered.vector for entry in self.entries])

    @property
    def sigma(self) -> NDArray[np.float64]:
        """``(n, 4)`` 1 σ of ``alpha``, model error included."""
        return to_boundary([entry.filtered_sigma for entry in self.entries])

    def plot(self, title: str = "") -> Figure:
        """Return α over time as a figure, as ``pyrcal track --plot`` draws it.

        Raises
        ------
        ConfigurationError
            If matplotlib, the extra ``plots``, is not installed.
        """
        return draw(self, title)


def to_boundary(vectors: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return vectors in numeric units as rows in the units of ``PARAMETERS``."""
    # Reshaped, because no vector at all must give (0, 4) as well.
    return np.asarray(np.array(vectors).reshape(-1, len(PARAMETERS)) * BOUNDARY_SCALE)


def table(track: Track) -> str:
    """Return the result in a few lines: α, its source, and problems."""
    seconds = (track.last_ns_utc - track.first_ns_utc) / SECOND_NS
    windows = track.state.windows
    missing = f", {track.n_missing} missing in {track.n_gaps} gaps" if track.n_missing else ""
    heading = (
        f"{track.n_frames} frames, {seconds:.1f} s{missing}; {windows.accepted} windows used, "
        f"{windows.refused} refused"
    )
    rows: list[Sequence[str]] = [("", *PARAMETERS)]
    registration = track.state.alpha.registration
    if registration is not None:
        rows.append(("alpha at the end", *_cells(registration.alpha.vector * BOUNDARY_SCALE)))
        rows.append(("1 sigma", *_cells(registration.shown_sigma * BOUNDARY_SCALE)))
    for source in Source:
        of_it = [entry for entry in track.entries if entry.source is source]
        if of_it:
            rows.append((f"{source.value}, {len(of_it)}x: scatter / sigma", *_scatter(of_it)))
            if out := sum(not entry.entered for entry in of_it):
                rows.append((f"{source.value}: {out}x rejected", *("" for _ in PARAMETERS)))
    if registration is None and track.passive:
        last = track.passive[-1]
        rows.append(("ordinary telemetry alone", *_cells(last.alpha.vector * BOUNDARY_SCALE)))
        rows.append(("1 sigma, its bias included", *_cells(last.sigma * BOUNDARY_SCALE)))
    rows += _file_rows(track, None if registration is None else registration.alpha.vector)
    lines = [heading, *(aligned(rows) if len(rows) > 1 else ())]
    if registration is None:
        lines.append(f"alpha was not found: {_explain_failure(track)}")
    if track.noisy is not None:
        lines.append(f"noisy matrix: {len(track.noisy.modes)} modes, S/N {track.noisy.snr:.1f}")
    return "\n".join([*lines, *_list_problems(track)])


def _file_rows(track: Track, found: Array | None) -> list[Sequence[str]]:
    """Return the file's own last α, if it says one, and how far from it the track ends."""
    if not track.stated:
        return []
    last = track.stated[-1].alpha.vector
    rows: list[Sequence[str]] = [
        (f"the file's own, last of {len(track.stated)}", *_cells(last * BOUNDARY_SCALE))
    ]
    if found is not None:
        # Both are angles of any turn, so the difference is brought to less than half a turn.
        apart = found - last
        apart[2] = wrap_angle(apart[2])
        rows.append(("found less the file's own", *_cells(apart * BOUNDARY_SCALE)))
    return rows


def _explain_failure(track: Track) -> str:
    """Return the most likely reason for which the telemetry gave no α."""
    if not track.n_frames:
        return "no frame could be used"
    if track.misaligned:
        return "slopes and commands are not of the same frames"
    if track.passive:
        return f"no dithered window; of ordinary telemetry {len(track.passive)}x: " + (
            track.passive[-1].text
        )
    reasons = (track.state.windows.refused_because, track.state.alpha.passive_unavailable_reason)
    return (
        "; ".join(str(reason) for reason in reasons if reason)
        or "it is too short, or holds no dither"
    )


def _cells(values: Array) -> list[str]:
    return [f"{value:.{digits}f}" for digits, value in zip(DIGITS, values, strict=True)]


def _scatter(entries: Sequence[HistoryEntry]) -> list[str]:
    """Return by how much windows scatter, over what they say of themselves.

    Neighbours are compared: a drift is no scatter.
    """
    entered = [entry for entry in entries if entry.entered]
    if len(entered) < MIN_WINDOWS:
        return ["too few"] * len(PARAMETERS)
    measured = np.array([entry.measured.vector for entry in entered])
    # The difference of two windows has twice the variance of one.
    scatter = np.sqrt(np.mean(np.diff(measured, axis=0) ** 2, axis=0) / 2.0)
    stated_sigma = np.sqrt(np.mean([entry.measured_sigma**2 for entry in entered], axis=0))
    return [f"{ratio:.2f}" for ratio in scatter / stated_sigma]


def _list_problems(track: Track) -> list[str]:
    """Return alarms that last, then what else the tracker warned of, the most frequent first."""
    # Responses of another frame look like responses of the opposite sign.
    led_to = _OF_MISALIGNED if track.misaligned else frozenset()
    lines = [f"note: {track.misaligned}"] if track.misaligned else []
    lines += [
        f"alarm {alarm.name}: {alarm.text}"
        for alarm in track.state.alarms.active
        # Consequences of misaligned streams are not listed with their cause.
        if alarm.name not in led_to
    ]
    names: Counter[str] = Counter()
    texts: dict[str, str] = {}
    # One line for each kind: the last text is the most recent one.
    for entry in track.lines:
        if entry.level in {Level.WARNING, Level.ALARM} and entry.name not in led_to:
            names[entry.name] += 1
            texts[entry.name] = entry.text
    lines += [
        f"{name} ({times}x): {texts[name]}" for name, times in names.most_common(_MAX_REASONS)
    ]
    return lines


def document(track: Track, source: Path) -> dict[str, Any]:
    """Return the result as one JSON object; its entries are like REST's of α."""
    registration, state = track.state.alpha.registration, track.state
    found: dict[str, Any] = {
        "telemetry": str(source),
        "misaligned": track.misaligned or None,
        **pick(track, "n_frames n_missing first_ns_utc last_ns_utc"),
        "alpha": None if registration is None else registration.alpha.to_boundary(),
        "covariance": None if registration is None else registration.covariance * COVARIANCE_SCALE,
        "entries": [_entry(entry) for entry in track.entries],
        "passive": [
            {
                **pick(one, "t_ns_utc estimator"),
                "alpha": one.alpha.to_boundary(),
                "sigma": at_boundary(one.sigma) if np.isfinite(one.sigma).all() else None,
                "text": one.text,
            }
            for one in track.passive
        ],
        "stated": [
            {
                "t_ns_utc": at.t_ns_utc,
                "alpha": at.alpha.to_boundary(),
                "anamorphosis": at.alpha.stretches,
            }
            for at in track.stated
        ],
        "alarms": [pick(alarm, "name text") for alarm in state.alarms.active],
        "windows": pick(state.windows, "accepted refused"),
    }
    document: dict[str, Any] = plain(found)
    return document


def _entry(entry: HistoryEntry) -> dict[str, Any]:
    return {
        **pick(entry, "t_ns_utc source"),
        "measured": entry.measured.to_boundary(),
        "measured_sigma": at_boundary(entry.measured_sigma),
        "filtered": entry.filtered.to_boundary(),
        "filtered_sigma": at_boundary(entry.filtered_sigma),
        **pick(entry, "innovation misfit entered in_use"),
    }


def fill(file: h5py.File, track: Track, source: Path) -> None:
    """Write everything found to an HDF5 file; registrations in the units of the parameters."""
    file.attrs.update(format=FORMAT, version=VERSION, telemetry=str(source))
    file.attrs["parameters"] = PARAMETERS
    entries, passive = track.entries, track.passive
    for name, values, what in (
        ("t_ns_utc", np.array([e.t_ns_utc for e in entries], np.int64), "(n,) end of telemetry"),
        ("source", np.array([e.source.value for e in entries], _TEXT), "(n,) estimator"),
        ("measured", to_boundary([e.measured.vector for e in entries]), "(n, 4) by itself"),
        ("measured_sigma", to_boundary([e.measured_sigma for e in entries]), "(n, 4) of the data"),
        ("filtered", track.alpha, "(n, 4) α after it"),
        ("filtered_sigma", track.sigma, "(n, 4) 1 sigma of it, the model's error included"),
        ("entered", np.array([e.entered for e in entries], bool), "(n,) whether it was accepted"),
        ("misfit", np.array([e.misfit for e in entries]), "(n,) residual power over noise"),
        ("passive/t_ns_utc", np.array([p.t_ns_utc for p in passive], np.int64), "(m,) ends"),
        ("passive/alpha", to_boundary([p.alpha.vector for p in passive]), "(m, 4) its bias in it"),
        ("passive/sigma", to_boundary([p.sigma for p in passive]), "(m, 4) 1 sigma of that"),
    ):
        put_array(file, name, values, what)
    if track.noisy is not None:
        put_array(file, "interaction_matrix", track.noisy.matrix, "noisy, slope per metre of OPD")
        put_array(file, "noise", np.median(track.noisy.noise, axis=0), "(n_modes,) 1 sigma")
        put_array(file, "modes", np.array(track.noisy.modes), "(n_modes,) basis indices")


def draw(track: Track, title: str) -> Figure:
    """Return a figure of α over time, every estimator's and the filtered one.

    Raises
    ------
    ConfigurationError
        If matplotlib is not installed.
    """
    figure = new_figure(11.0, 9.0)
    figure.suptitle(title)
    every = figure.subplots(len(PARAMETERS), 1, sharex=True)
    for k, axes in enumerate(every):
        _draw(axes, track, k)
    if track.entries or track.passive:
        every[0].legend(fontsize="small", ncols=4)
    every[-1].set_xlabel("seconds since the first frame")
    return figure


def _draw(axes: Axes, track: Track, k: int) -> None:
    """Draw one parameter."""

    def seconds(ends_ns: Sequence[int]) -> Array:
        return (np.array(ends_ns) - track.first_ns_utc) / SECOND_NS

    passive = to_boundary([one.alpha.vector for one in track.passive])[:, k]
    ends = seconds([one.t_ns_utc for one in track.passive])
    axes.plot(ends, passive, "x", color="0.6", label="ordinary telemetry, its bias in it")
    for source, colour in _COLOURS.items():
        chosen = [entry for entry in track.entries if entry.source is source]
        if chosen:
            ends = seconds([entry.t_ns_utc for entry in chosen])
            values = to_boundary([entry.measured.vector for entry in chosen])[:, k]
            sigma = to_boundary([entry.measured_sigma for entry in chosen])[:, k]
            axes.errorbar(ends, values, sigma, fmt=".", color=colour, label=source.value)
            # The range is that of the last source: outliers of the others may be cut off.
            margin = 3.0 * to_boundary([entry.filtered_sigma for entry in chosen])[:, k].max()
            axes.set_ylim(values.min() - margin, values.max() + margin)
    if track.entries:
        filtered, width = track.alpha[:, k], track.sigma[:, k]
        axes.plot(track.t, filtered, color="tab:red", linewidth=1.0, label="filtered")
        low, high = filtered - width, filtered + width
        axes.fill_between(track.t, low, high, color="tab:red", alpha=0.15, linewidth=0)
    axes.set_ylabel(f"{PARAMETERS[k]}\n{UNITS[k]}".strip())
    axes.grid(alpha=0.3)
