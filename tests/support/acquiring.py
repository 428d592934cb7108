"""What tests of several modules share of unit.tracking.operations.test_acquisition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.model.misregistration import Misregistration
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import RefusalKind, WideCaptureEstimate, WindowRefused
from service.records.state import Mode
from service.wire import DitherRequest, Loop, LoopRequest
from tests.support.situations import (
    POLICY,
    Story,
    dither_answered,
    estimate,
    loop_answered,
    moved,
    rtc,
)

ACQUIRES = replace(POLICY, acquires=True)


FAR = Misregistration(
    shift_x_subap=1.2, shift_y_subap=-0.9, rotation_rad=np.deg2rad(4.0), magnification=0.97
)


DIVERGING = ev.ConditionChanged(name="loop-diverging", text="found")


CALM = ev.ConditionChanged(name="loop-diverging", text="gone", over=True)


class Acquiring(Story):
    """A story with an RTC that does what it is told."""

    def __init__(self, mode=Mode.AUTO, policy=ACQUIRES):
        super().__init__(mode, policy)
        self.session = 1
        self.meet()

    @property
    def stage(self):
        return self.state.operations.acquisition.stage

    @property
    def text(self):
        return self.state.operations.acquisition.text

    @property
    def far_dithers(self):
        return [dither for dither in self.asked(DitherRequest) if dither.id.startswith("acquire-")]

    def status(self, after_s=0.2, **changes):
        seen = {"session": f"s{self.session}", "cm_id": self.state.matrices.in_use} | changes
        return self.tell(rtc(**seen), after_s)

    def open(self):
        """The RTC opens the loop, which begins a new session."""
        command = self.asked(LoopRequest)[-1]
        assert command.loop is Loop.OPEN
        self.tell(loop_answered(command.id, accepted=True, reason=""), 0.1)
        self.session += 1
        self.tell(ev.SessionStarted(session=f"s{self.session}"))
        self.tell(CALM)
        self.tell(replace(CALM, name="loop-lost"))
        return self.still_open()

    def still_open(self, **changes):
        gains = (0.0,) * 594
        return self.status(loop="open", gains=gains, **{"cm_id": "initial"} | changes)

    def see_afar(self, alpha=FAR, sigma=0.01):
        """A window with the dither of this stage puts the mirror there."""
        dither = self.state.dithers.dither
        self.tell(dither_answered(dither.id, accepted=True, reason="", start_seq=5000), 0.1)
        fitted = estimate(
            alpha,
            t_ns=self.now_ns,
            session=f"s{self.session}",
            modes=dither.request.modes,
            covariance=np.diag([sigma, sigma, sigma / 30, sigma / 10]) ** 2,
        )
        found = WideCaptureEstimate(estimate=fitted, unexplained=0.05, n_starts=1)
        effects = self.tell(ev.WideCaptureFitted(found=found), 3.0)
        self.still_open(dither=replace(dither, start_seq=5000))
        self.still_open()
        return effects

    def miss_afar(self, reason="registration not found: nothing fits", kind=RefusalKind.NOT_FOUND):
        lost = WindowRefused(reason=reason, t_ns_utc=self.now_ns, kind=kind)
        return self.tell(ev.WindowLost(refused=lost), 2.0)

    def close(self, n_modes):
        """The reconstructor asked for is made, applied, and the loop closes on it."""
        name = f"cm-{len(self.asked(ev.SendMatrix))}-{n_modes}"
        self.make(name, n_modes=n_modes)
        self.acknowledge(name)
        self.still_open(cm_id=name)
        command = self.asked(LoopRequest)[-1]
        assert command.loop is Loop.CLOSED
        self.tell(loop_answered(command.id, accepted=True, reason=""), 0.1)
        return self.closed(n_modes)

    def closed(self, n_modes):
        return self.status(n_controlled=n_modes)

    def widen(self, n_modes):
        """One more reconstructor is made and swapped in."""
        name = f"cm-{len(self.asked(ev.SendMatrix))}-{n_modes}"
        self.make(name, n_modes=n_modes)
        self.acknowledge(name)
        return self.closed(n_modes)

    def to_partial(self):
        self.tell(cmd.Acquire())
        self.open()
        self.see_afar()
        self.see_afar(moved(FAR, shift_x_subap=0.02))
        return self

    def to_widening(self):
        self.to_partial()
        self.close(150)
        return self
