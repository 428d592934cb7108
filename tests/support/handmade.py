"""An RTC written by hand, a clock that goes on when it is asked, a night on which α is known."""

from dataclasses import replace

import numpy as np

from service.model.misregistration import Misregistration
from service.records.registration import Registration
from service.runtime.estimator_bank import close_sums
from service.wire import Reply, layout_of
from tests.support.situations import START_NS, foreign, rtc
from tests.support.small import N_CONTROLLED, SIGMA
from tests.support.states import tracker_state

N_SLOPES, N_MODES = 224, 90
ALPHA = Misregistration(shift_x_subap=0.1, rotation_rad=0.003)
RTC = rtc(
    N_CONTROLLED,
    n_modes=N_MODES,
    n_slopes=N_SLOPES,
    gains=(0.4,) * N_CONTROLLED + (0.0,) * (N_MODES - N_CONTROLLED),
)
BROUGHT = np.full((N_CONTROLLED, N_SLOPES), 1e-6, np.float32)


REGISTRATION = Registration(
    alpha=ALPHA,
    covariance=np.diag(SIGMA**2),
    floor=SIGMA,
    t_ns_utc=START_NS,
    arrived_ns_utc=START_NS,
    n_windows=2,
    optical_gain=0.6,
)
STATE = tracker_state(
    system="small",
    rtc=RTC,
    registration=REGISTRATION,
    reconstructors=(foreign(),),
    in_use="initial",
)


class HandmadeBridge:
    """Keeps what it is told to send and answers as a test wants."""

    def __init__(self):
        self.published = []
        self.commands = []
        self.offered = []
        self.current = None
        self.refusal = None
        self.applied = (foreign().manifest(layout_of(BROUGHT, 4096), RTC, "small"), BROUGHT)

    async def publish(self, manifest, matrix):
        self.published.append((manifest, matrix))

    async def command(self, command):
        self.commands.append(command)
        accepted = self.refusal is None
        return Reply(id=command.id, accepted=accepted, reason=self.refusal or "", start_seq=77)

    async def fetch_applied(self):
        return self.applied

    def offer(self, manifest, matrix):
        self.offered.append((manifest, matrix))

    def set_current(self, matrix_id):
        self.current = matrix_id

    def keep(self, recorder, before_s=0.0):
        self.recorder = recorder
        return before_s


class Clock:
    def __init__(self):
        self.now_ns = START_NS

    def __call__(self):
        self.now_ns += 1_000_000
        return self.now_ns


def take_sums(bank, **told):
    """Return the bank, and what the passive estimate has summed or why it has not."""
    return close_sums(bank, **told)


def with_member(bank, member):
    """Return the bank with another estimator of its kind."""
    members = tuple(member if type(m) is type(member) else m for m in bank.members)
    return replace(bank, members=members)
