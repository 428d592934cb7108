"""Record the truth of a run as lines of a file."""

from __future__ import annotations

import json
import queue
from collections import deque
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TextIO

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from pyrcal.rtc.background import Background
from service.model.misregistration import PARAMETERS
from sim_rtc.computer.telemetry import Batch, FrameClock
from sim_rtc.options import Options
from sim_rtc.telescope.imperfections import low_orders

if TYPE_CHECKING:
    pass

Array = NDArray[np.float64]

_LINE_S = 0.5
_SWAP_S = 1.0
"""Stretch before and after a swap in which the largest wavefront error is sought."""

_BACKLOG_BATCHES = 400

LOW_ORDER = 5
"""Highest order of the polynomials in which static aberrations are sought: 20 without piston."""

_STATIC_LINES = 20
"""Lines over which the wavefront is averaged, 10 s: turbulence leaves some nanometres."""


@dataclass(slots=True, kw_only=True)
class _Swap:
    """A reconstructor swap whose second half is still to come."""

    seq: int
    cm_id: str
    frames_skipped: int
    before_nm: float
    after_nm: list[float] = field(default_factory=list)


class WavefrontError:
    """Residual wavefront of the science path over the pupil, piston removed."""

    def __init__(self, weights: Array, points_m: Array | None = None) -> None:
        """Take the pupil's ``weights`` ``(n_points,)``; ``points_m`` are for `low_orders_nm`."""
        self._weights = weights.astype(np.float32)
        self._low_orders: NDArray[np.float32] | None = None
        if points_m is not None:
            shapes = weights[:, None] * low_orders(points_m, weights, LOW_ORDER)[:, 1:]
            self._low_orders = shapes.astype(np.float32)

    def rms_nm(self, residual_m: NDArray[np.float32]) -> list[float]:
        """Return the RMS of each wavefront ``(n, n_points)`` of :meth:`residual_m`, nm."""
        return [float(rms) * 1e9 for rms in np.sqrt(residual_m**2 @ self._weights)]

    def low_orders_nm(self, residual_m: NDArray[np.float32]) -> Array | None:
        """Return the mean of the wavefronts in each low order ``(20,)``, nm RMS.

        None if the points of the pupil are not known.
        """
        if self._low_orders is None:
            return None
        return np.asarray(1e9 * (residual_m.mean(axis=0) @ self._low_orders), dtype=np.float64)

    def residual_m(self, batches: list[Batch]) -> NDArray[np.float32]:
        """Return the wavefront ``(n_batches, n_points)`` of the first frame of each batch, metres.

        All batches have the same optics.
        """
        modes = batches[0].optics.opd_per_command
        commands = np.array([batch.commands_m[0] for batch in batches])
        n_moved = int(np.flatnonzero(commands.any(axis=0))[-1]) + 1 if commands.any() else 0
        # in this order: for ten commands a copy of the modes would cost as much as the product
        residual = np.ascontiguousarray((modes[:, :n_moved] @ commands[:, :n_moved].T).T)
        residual += np.array([batch.phase_m for batch in batches])
        # Piston is no wavefront error: no image shows it.
        residual -= (residual @ self._weights)[:, None]
        return residual


class TruthRecorder(Background):
    """Writes JSON lines in a thread of its own while its ``with`` block lasts."""

    def __init__(
        self,
        path: Path,
        *,
        weights: Array,
        points_m: Array | None = None,
        clock: FrameClock,
        options: Options | None = None,
        image_offsets_px: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the pupil's ``weights`` ``(n_points,)`` and points, and the options to be recorded.

        ``image_offsets_px`` ``(4, 2)`` are the displacements of the pupil images, if there are any.
        """
        super().__init__("truth")
        self._path = path
        self._options = options
        self._image_offsets_px = None if image_offsets_px is None else image_offsets_px.tolist()
        self._error = WavefrontError(weights, points_m)
        self._static_nm: deque[Array] = deque(maxlen=_STATIC_LINES)
        self._clock = clock
        self._line_frames = round(_LINE_S * 1e9 / clock.dt_ns)
        self._swap_frames = round(_SWAP_S * 1e9 / clock.dt_ns)
        self._queue: queue.Queue[tuple[Batch, int, float] | None] = queue.Queue(_BACKLOG_BATCHES)
        self._recent: deque[tuple[int, float]] = deque()
        self._swaps: list[_Swap] = []
        self._last: Batch | None = None

    @override
    def __enter__(self) -> Self:
        self._file: TextIO = self._path.open("w", encoding="utf-8")
        if self._options is not None:
            found = {"image_offsets_px": self._image_offsets_px}
            self._write({"kind": "setup", **setup_of(self._options), **found})
        return super().__enter__()

    @override
    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        super().__exit__()
        self._file.close()

    def offer(self, batch: Batch, overrun_frames: int, behind_s: float = 0.0) -> None:
        """Queue a batch; waits only if the recorder is seconds of work behind.

        ``overrun_frames`` so far came late; the batch came ``behind_s`` after it was due.
        """
        # Waits, unlike the telemetry: the truth must have no gaps.
        self._queue.put((batch, overrun_frames, behind_s))

    @override
    def _work(self) -> None:
        pending: list[Batch] = []
        overruns, behind_s = 0, 0.0
        while (item := self._queue.get()) is not None:
            batch, overruns, behind_s = item
            if pending and self._is_boundary(pending, batch):
                self._write_interval(pending, overruns, behind_s)
                pending = []
            pending.append(batch)
        if pending:
            self._write_interval(pending, overruns, behind_s)

    def _is_boundary(self, pending: list[Batch], batch: Batch) -> bool:
        """Return whether ``batch`` begins a new line: time is up, or something else is true."""
        first = pending[0]
        return (
            batch.seq0 - first.seq0 >= self._line_frames
            or batch.optics is not first.optics
            or batch.cm_id != first.cm_id
            or batch.session != first.session
            or batch.identity != first.identity
        )

    def _write_interval(self, batches: list[Batch], overruns: int, behind_s: float) -> None:
        residual_m = self._error.residual_m(batches)
        errors_nm = self._error.rms_nm(residual_m)
        first, last = batches[0], batches[-1]
        self._note_swap(first)
        for batch, error_nm in zip(batches, errors_nm, strict=True):
            self._recent.append((batch.seq0, error_nm))
            for swap in self._swaps:
                if batch.seq0 < swap.seq + self._swap_frames:
                    swap.after_nm.append(error_nm)
        end_seq = last.seq0 + len(last.slopes) - 1
        self._write(
            {
                "kind": "truth",
                "t_ns_utc": self._clock.end_of_exposure_ns(end_seq),
                "seq": end_seq,
                **self._alpha(last),
                "seeing_arcsec": self._seeing_arcsec(end_seq),
                "wavefront_error_nm": round(float(np.sqrt(np.mean(np.square(errors_nm)))), 3),
                "wavefront_error_peak_nm": round(max(errors_nm), 3),
                **self._static(first, self._error.low_orders_nm(residual_m)),
                "cm_id": last.cm_id,
                "n_controlled": last.n_controlled,
                "loop": "closed" if last.closed else "open",
                "dither_on": any(batch.dither_m is not None for batch in batches),
                "clipped": sum(batch.n_clipped for batch in batches),
                "overrun_frames": overruns,
                "behind_s": round(max(behind_s, 0.0), 2),
            }
        )
        self._finish_swaps(end_seq)
        while self._recent and self._recent[0][0] < end_seq - self._swap_frames:
            self._recent.popleft()
        self._last = last

    def _static(self, batch: Batch, low_orders_nm: Array | None) -> dict[str, Any]:
        """Return the mean wavefront of this line in each low order, and the static error.

        The static error is the RMS of the mean since the references changed, over 10 s at most.
        """
        if low_orders_nm is None:
            return {}
        if self._last is None or self._last.identity != batch.identity:
            self._static_nm.clear()
        self._static_nm.append(low_orders_nm)
        static_nm = float(np.linalg.norm(np.mean(self._static_nm, axis=0)))
        return {
            "reference_id": batch.identity.reference_id,
            "static_error_nm": round(static_nm, 3),
            "low_orders_nm": [round(float(each), 3) for each in low_orders_nm],
        }

    def _alpha(self, batch: Batch) -> dict[str, float | None]:
        """Return the true registration; None for each parameter that is not known."""
        options = self._options
        if options is not None and options.plant == "measured" and options.alpha is None:
            return dict.fromkeys(PARAMETERS)
        return dict(batch.optics.alpha.to_boundary())

    def _seeing_arcsec(self, seq: int) -> float | None:
        if self._options is None:
            return None
        time_s = np.array([seq * self._clock.dt_ns * 1e-9])
        return round(float(self._options.seeing.arcsec(time_s)[0]), 4)

    def _note_swap(self, first: Batch) -> None:
        last = self._last
        if last is None or last.cm_id == first.cm_id:
            return
        self._swaps.append(
            _Swap(
                seq=first.seq0,
                cm_id=first.cm_id,
                frames_skipped=first.seq0 - (last.seq0 + len(last.slopes)),
                before_nm=max(error_nm for _, error_nm in self._recent),
            )
        )

    def _finish_swaps(self, end_seq: int) -> None:
        for swap in list(self._swaps):
            if end_seq + 1 >= swap.seq + self._swap_frames:
                self._swaps.remove(swap)
                self._write(
                    {
                        "kind": "swap",
                        "seq": swap.seq,
                        "cm_id": swap.cm_id,
                        "peak_before_nm": round(swap.before_nm, 3),
                        "peak_after_nm": round(max(swap.after_nm), 3),
                        "frames_skipped": swap.frames_skipped,
                    }
                )

    def _write(self, record: dict[str, Any]) -> None:
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()


def setup_of(options: Options) -> dict[str, Any]:
    """Return the constants of the run as JSON can hold them."""
    recorded = (
        *("scene", "imperfections", "seeing", "layers", "vibrations"),
        *("flexure", "walk", "elevation"),
    )
    return {
        "plant": options.plant,
        "matrix": None if options.matrix is None else str(options.matrix),
        "influence": options.influence_cube,
        "instrument": options.instrument,
        "seed": options.seed,
        "magnitude": options.magnitude,
        "frame_rate_hz": options.frame_rate_hz,
        "delay_frames": options.delay_frames,
        "outer_scale_m": options.outer_scale_m,
        "drift_per_minute": asdict(options.drift),
        "jumps": _json(options.jumps),
        **{name: _json(getattr(options, name)) for name in recorded},
    }


def _json(value: Any) -> Any:  # noqa: ANN401 - a record, or several
    """Return records as JSON."""
    return [asdict(one) for one in value] if isinstance(value, tuple) else asdict(value)
