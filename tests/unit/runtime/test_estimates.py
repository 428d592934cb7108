"""Looks at ordinary telemetry: taken whether or not α is known, or the reason why not."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimation import passive
from service.estimation.loop import loop_numbers
from service.records import events as ev
from service.records.messages import compose
from service.records.state import Mode
from service.runtime.estimates import PendingWindow, fit_passive
from service.runtime.worker import OpticsWorker
from tests.support.lockin import run, telemetry
from tests.support.numerics import block_of
from tests.support.situations import ALPHA, Story
from tests.support.watchdog import watched as look


class Worker:
    """Answers every job with the same look, and remembers about what it was to be fitted."""

    def __init__(self):
        self.begun_at = []

    async def call(self, job, sums, start):
        assert job is OpticsWorker.fit_passive
        self.begun_at.append(start)
        return look(ALPHA)


@pytest.fixture
def sums():
    frames = block_of(np.zeros((40, 6)), np.zeros((40, 4)), None)
    return replace(passive.Passive(n_modes=4, memory_frames=1000.0), tail=frames)


async def test_a_look_is_taken_though_alpha_is_not_known(sums):
    """It says what it can tell, from the nominal rotation on; the tracker says what it is worth."""
    worker, story = Worker(), Story(Mode.HOLD).meet()
    (event,) = await fit_passive(sums, story.state, worker)
    assert worker.begun_at == [None]
    assert event.loop == loop_numbers(story.state.loop.rtc)
    assert event.t_ns_utc == sums.tail.t0_ns_utc + 39 * sums.tail.dt_ns
    story.tell(event)
    await fit_passive(sums, story.state, worker)
    assert worker.begun_at[1] == ALPHA


async def test_why_there_is_none_is_told_once():
    worker, story = Worker(), Story(Mode.HOLD).meet()
    (event,) = await fit_passive("the loop is open", story.state, worker)
    assert event == ev.PassiveUnavailable(text="the loop is open")
    story.tell(event)
    assert await fit_passive("the loop is open", story.state, worker) == []
    assert worker.begun_at == []


async def test_windows_that_end_while_one_waits_are_joined_to_it():
    backlog, windows = PendingWindow(), run(telemetry(6200))
    assert [backlog.put(window) for window in windows] == [None] * 6
    await backlog.some()
    window = backlog.take()
    assert (window.n_windows, window.window_s) == (6, 6.0)
    assert window.t_end_ns_utc == windows[-1].t_end_ns_utc
    assert backlog.take() is None
    assert not backlog.waits


async def test_a_window_that_cannot_be_joined_is_given_up_and_why_is_said():
    backlog, (first, second) = PendingWindow(), run(telemetry(2200))
    backlog.put(first)
    refused = backlog.put(replace(second, cm_id="another"))
    assert refused.t_ns_utc == first.t_end_ns_utc
    assert refused.reason.code == "window.given-up"
    assert backlog.take().cm_id == "another"


async def test_no_window_becomes_so_long_that_alpha_moves_in_it():
    backlog, (first, second) = PendingWindow(), run(telemetry(2200))
    backlog.put(first)
    late = replace(second, t_end_ns_utc=first.t_end_ns_utc + 31 * 10**9)
    assert backlog.put(late).reason == compose("window.given-up", most_s=30.0)
    assert backlog.take().n_windows == 1
