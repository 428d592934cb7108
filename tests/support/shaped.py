"""A loop that holds a shape: its RTC uses the references that it is sent."""

from dataclasses import replace

import numpy as np

from service.records import commands as cmd
from service.records import events as ev
from service.records.products import Frame, MatrixState, ReferencesRecord, ShapeKind
from service.records.registration import ModeGain
from service.tracking.references import mean_gain
from service.wire import ReferencesInUse, ReferencesRequest, Reply
from tests.support.situations import Story, rtc
from tests.support.states import changed

LOADED = cmd.LoadShape(
    kind=ShapeKind.MODES, frame=Frame.MIRROR, values=(0.0, 0.0, 60.0), unit="nm", by="E. Hubble"
)
COEFFICIENTS = (0.0, 0.0, 6e-8)
OTHER_SUM = "b" * 64


class ShapedStory(Story):
    """Tells of references as the worker makes them and the RTC takes them."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.meet()
        self.see(n_windows=3)
        self.measure_gain(0.6)

    def measure_gain(self, gain, sigma=0.01):
        """Let windows have measured this optical gain."""
        found = ModeGain(mode=2, gain=gain, sigma=sigma, scatter=0.02, t_ns_utc=self.now_ns)
        known = replace(self.state.alpha.registration, optical_gains=(found,))
        self.state = changed(self.state, registration=known)
        return self

    def load(self, command=LOADED):
        """Load a shape."""
        self.tell(command)
        return self

    @property
    def references(self):
        """All records of references, oldest first."""
        return self.state.references.records

    @property
    def last(self):
        return self.references[-1]

    def make_references(self, state=MatrixState.PROPOSED, **changes):
        """Hand in those that the service has asked for."""
        asked = self.asked(ev.MakeReferences)[-1]
        registration = self.state.alpha.registration
        made = ReferencesRecord(
            id=asked.id,
            state=state,
            created_ns_utc=self.now_ns,
            shape=self.state.references.shape.id,
            coefficients_m=COEFFICIENTS,
            alpha=registration.alpha,
            gain=mean_gain(COEFFICIENTS, registration.optical_gains),
            sha256="a" * 64,
        )
        self.tell(ev.ReferencesMade(record=replace(made, **changes)), cause=asked.cause)
        return self

    def use_references(self):
        """Make references, approve them where that is needed, and have the RTC use them."""
        self.make_references()
        if self.last.state is MatrixState.PROPOSED:
            self.tell(cmd.ApproveReferences(id=self.last.id))
        return self.name_references()

    def answer_references(self, *, accepted=True, reason=""):
        """Let the RTC reply to those sent last."""
        reply = Reply(id="r-1", accepted=accepted, reason=reason, start_seq=None)
        request = ReferencesRequest(
            id="r-1",
            reference_id=self.last.id,
            config_id="pyramid-30",
            slopes=b"",
            sha256=self.last.sha256,
            ramp_s=1.0,
        )
        return self.tell(ev.Answered(request=request, reply=reply))

    def name_references(self, name=None, after_s=0.2):
        """Let a status name references, by default those made or sent last."""
        self.tell(rtc(reference_id=name or self.last.id), after_s)
        return self

    def show_references(self, sha256=None, name=None):
        """Let the RTC show what it subtracts."""
        used = self.state.references.used_id
        record = self.state.references_of(used)
        offset = np.full(4, -0.0 if record.shape is None else 0.1, "<f4")
        shown = ReferencesInUse(
            reference_id=name or used, slopes=offset.tobytes(), sha256=sha256 or record.sha256
        )
        return self.tell(ev.ReferencesFetched(in_use=shown))
