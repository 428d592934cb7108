"""An RTC that plays what it is asked, and windows as precise as a star allows, as values."""

from dataclasses import replace

import numpy as np

from service.control.dither import look_up_precision
from service.estimation.windows import DITHER_SETTLING_S
from service.records import events as ev
from service.records.estimates import PassiveEstimate
from service.records.state import Mode
from service.tracking.dither_request import total_m
from service.wire import DitherRequest, DitherStatus, DitherStop
from tests.support.situations import ALPHA, Story, dither_answered, estimate, moved, rtc

STEP_S = 0.5
LOOK_S = 10.0
"""Between two looks of the passive watchdog."""


class DitheredNight(Story):
    """A night in steps of half a second; ``lived`` is what was on the mirror in each of them."""

    def __init__(
        self, policy, *, magnitude=10.0, kappa=None, alpha=lambda t_s: ALPHA, looks=False, **changes
    ):
        super().__init__(Mode.HOLD, policy)
        self.looks = looks
        self.deaf = False
        self.view = rtc(magnitude=magnitude, **changes)
        self.kappa = look_up_precision(magnitude) if kappa is None else kappa
        self.alpha = alpha
        self.t_s = 0.0
        self.playing = None
        self.done_s = 0.0
        self.lived = []
        self.requests = []
        self.windows_s = []
        self.tell(ev.SessionStarted(session="s1"))
        self.pass_on(self.tell(self.view))
        self.pass_on(self.meet(magnitude=magnitude, **changes).effects)

    @property
    def seq(self):
        return round(self.t_s * self.view.frame_rate_hz)

    def pass_on(self, effects):
        for effect in effects:
            match effect:
                case ev.Ask(request=DitherRequest() as request):
                    self.requests.append(request)
                    self.windows_s.append(self.state.dithers.dither.window_s)
                    self.playing = replace(self.state.dithers.dither, start_seq=self.seq)
                    self.done_s = self.t_s + DITHER_SETTLING_S
                    answer = dither_answered(
                        request.id, accepted=True, reason="", start_seq=self.seq
                    )
                    self.pass_on(self.tell(answer))
                case ev.Ask(request=DitherStop()) if not self.deaf:
                    self.playing = None
                case _:
                    pass

    def live(self, seconds):
        for _ in range(round(seconds / STEP_S)):
            self.t_s += STEP_S
            self.pass_on(self.tell(ev.Tick(), STEP_S))
            self.play()
            shown = self.playing
            status = replace(
                self.view,
                seq=self.seq,
                t_ns=self.now_ns,
                dither=shown and DitherStatus(request=shown.request, start_seq=shown.start_seq),
            )
            self.pass_on(self.tell(status))
            if self.looks and round(self.t_s / STEP_S) % round(LOOK_S / STEP_S) == 0:
                self.pass_on(self.tell(self.look()))
            self.lived.append(0.0 if self.playing is None else total_m(self.playing.request))
        return self

    def play(self):
        playing = self.playing
        if playing is None:
            return
        window_s = (
            self.state.dithers.dither.window_s if self.state.dithers.dither else playing.window_s
        )
        while self.done_s + window_s <= self.t_s:
            self.done_s += window_s
            self.window(playing, window_s)
            if self.playing is not playing:
                return
        ended_s = (playing.start_seq / self.view.frame_rate_hz) + playing.request.duration_s
        if self.t_s >= ended_s:
            self.playing = None

    def window(self, playing, window_s):
        sigma = self.kappa / (total_m(playing.request) * np.sqrt(window_s))
        found = estimate(
            self.alpha(self.t_s),
            t_ns=self.now_ns,
            covariance=np.diag(sigma**2),
            dither_m=total_m(playing.request),
            window_s=window_s,
        )
        self.pass_on(self.tell(ev.WindowFitted(estimate=found)))

    def look(self):
        """The passive watchdog, off by a steady wind."""
        off = moved(self.alpha(self.t_s), shift_x_subap=0.04)
        found = PassiveEstimate(
            alpha=off,
            covariance=np.diag([0.003, 0.003, 1e-4, 1e-4]) ** 2,
            optical_gain=np.full(400, 0.6),
            misfit=1.0,
            step=np.zeros(4),
        )
        return ev.PassiveFitted(estimate=found, t_ns_utc=self.now_ns)

    @property
    def share_on(self):
        return float(np.mean(np.array(self.lived) > 0.0))

    @property
    def mean_m(self):
        return float(np.sqrt(np.mean(np.square(self.lived))))
