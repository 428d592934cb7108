"""Pair each frame of slopes with the command on the mirror.

cacao counts each stream separately. A command answers a frame of slopes, which its trace names. It
is on the mirror ``delay_frames`` exposures later, so row k contains slopes k and the command that
answers k - delay; with a delay of 1.7 frames, seven tenths of the older of two commands. Both are
counted by the frame of slopes that they answer. A row is sent when it is complete.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.wire import BATCH_LIMIT, FRAMES_PER_BATCH

Array32 = NDArray[np.float32]

PATIENCE_FRAMES: Final = 64
"""A row whose command has not come so many frames later is left out, and counted, if that of a
later one has. Where none has come at all it is waited for longer: half of what is held."""

LEAST_KEPT: Final = 512
"""Frames of each stream that are held at least."""

_NEVER: Final = -(2**62)


class Rows:
    """The last frames of both streams, paired.

    Parameters
    ----------
    n_slopes, n_modes
        Columns.
    delay_frames
        From an exposure to the one that the answer to it is on the mirror for; 1 or more.
    dither
        Whether rows end with the dither's share of the command.
    kept
        Frames of each stream that are held: more at once are too many.
    """

    def __init__(
        self,
        n_slopes: int,
        n_modes: int,
        delay_frames: float,
        *,
        dither: bool,
        kept: int = LEAST_KEPT,
    ) -> None:
        self._kept = kept
        self._delay = int(delay_frames)
        self._older = np.float32(delay_frames - self._delay)
        self._slopes = np.zeros((kept, n_slopes), dtype=np.float32)
        self._commands_m = np.zeros((kept, n_modes), dtype=np.float32)
        self._dither_m = np.zeros((kept, n_modes if dither else 0), dtype=np.float32)
        n_bytes = 4 * (n_slopes + n_modes * (1 + dither))
        self._per_message = max(1, min(FRAMES_PER_BATCH, BATCH_LIMIT // n_bytes))
        self.n_unpaired = 0
        """Frames that were left out because their command never came."""
        self.forget()

    def forget(self) -> None:
        """Discard all rows and begin again."""
        self._of_slopes, self._of_commands = np.full((2, self._kept), _NEVER)
        self._dither_m[:] = 0.0
        self.next = self._newest = -1
        """The first frame that has not left; -1: there is none."""

    def take_slopes(self, first: int, values: Array32) -> None:
        """Take ``(n, n_slopes)`` of frames from ``first`` on."""
        self._put(self._slopes, self._of_slopes, first, values)
        # The ring still holds the dither of the frame that had this place before.
        self.take_dither(first, first + len(values) - 1, 0.0)
        if self.next < 0:
            self.next = first
        self._newest = max(self._newest, first + len(values) - 1)

    def take_commands(self, first: int, values: Array32) -> None:
        """Take ``(n, n_modes)`` metres: the loop's answers to frames from ``first`` on."""
        self._put(self._commands_m, self._of_commands, first, values)

    def take_dither(self, first: int, last: int, values: Array32 | float) -> None:
        """Take ``(n_modes,)`` metres, played in answer to all frames from ``first`` to ``last``.

        Where nothing is said after the slopes have come, nothing was played.
        """
        self._dither_m[np.arange(max(first, last - self._kept + 1), last + 1) % self._kept] = values

    def _put(self, kept: Array32, counters: NDArray[np.int64], first: int, values: Array32) -> None:
        # More frames than places would write several into one place.
        values = values[-self._kept :]
        frames = np.arange(len(values)) + first
        kept[frames % self._kept], counters[frames % self._kept] = values, frames

    def ready(self, answers_to: int | None = None) -> list[tuple[int, Array32]]:
        """Return the rows that are complete, as runs of consecutive frames with their first.

        At most as many rows in each as a message may have. ``answers_to`` is the last frame of
        which it is known what was played in answer to it; None: nothing plays.
        """
        runs: list[tuple[int, Array32]] = []
        if self.next < 0:
            return runs
        # Older frames need commands whose place in the ring has been overwritten.
        self.skip(self._newest - self._kept + self._delay + 2)
        newest = self._newest if answers_to is None else min(self._newest, answers_to + self._delay)
        frames = np.arange(self.next, newest + 1)
        whole = self._complete(frames)
        for first, last in _runs(whole):
            if self.next < frames[first]:
                # A gap is waited for before later rows leave, because frames are sent in order.
                if self._newest - self.next < PATIENCE_FRAMES:
                    break
                self.skip(int(frames[first]))
            for start in range(first, last, self._per_message):
                part = frames[start : min(start + self._per_message, last)]
                runs.append((int(part[0]), self._rows(part)))
            self.next = int(frames[last - 1]) + 1
        # If no command comes at all, there is no complete run above that could end the wait.
        self.skip(self._newest - self._kept // 2)
        return runs

    def _complete(self, frames: NDArray[Any]) -> NDArray[np.bool_]:
        whole: NDArray[np.bool_] = self._of_slopes[frames % self._kept] == frames
        # A whole number of frames needs no older answer, which may not exist.
        for answered in (frames - self._delay, frames - self._delay - 1)[: 1 + bool(self._older)]:
            whole &= self._of_commands[answered % self._kept] == answered
        return whole

    @property
    def newest(self) -> int:
        """The last frame of slopes taken; -1: none."""
        return self._newest

    def skip(self, to: int) -> None:
        """Leave out rows before ``to`` that have not left yet."""
        if to > self.next:
            self.n_unpaired += to - self.next
            self.next = to

    def _rows(self, frames: NDArray[Any]) -> Array32:
        dither_m = self._on_mirror(self._dither_m, frames)
        commands_m = self._on_mirror(self._commands_m, frames)
        if dither_m.shape[1]:
            commands_m += dither_m
        return np.hstack([self._slopes[frames % self._kept], commands_m, dither_m])

    def _on_mirror(self, answers: Array32, frames: NDArray[Any]) -> Array32:
        """Return the mean over each exposure of answers that came a part of a frame late."""
        newer: Array32 = answers[(frames - self._delay) % self._kept]
        if not self._older:
            return newer
        older = answers[(frames - self._delay - 1) % self._kept]
        return np.asarray(self._older * older + (1 - self._older) * newer)


def _runs(whole: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and end of each run of trues."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
