"""A worker that is restarted at any moment gives the same results: its model is in the state."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace

import pytest
from threadpoolctl import threadpool_limits

from pyrcal_studies.campaign.golden import COMPARED, first_difference
from pyrcal_studies.campaign.golden_nights import NIGHTS, SMALL, GoldenNight
from pyrcal_studies.campaign.observatory import OwnHands
from service.files.disk_cache import usual_folder
from service.instrument import load_instrument
from service.records.state import ModelState
from service.runtime.worker import Compute, OpticsWorker, Sampling

INSTRUMENT = load_instrument(SMALL)
PLANS = {plan.name: plan for plan in NIGHTS}
AT_WORK = Sampling(working_point_modes=45)
"""The model follows the optical gains of dithered modes: its working point moves."""


class Restarted(OwnHands):
    """A worker that has died before every job; the next one has nothing but the state."""

    forgets = False
    """True if it does not even have that."""

    def __init__(self, workbench):
        super().__init__(workbench)
        self.compute = workbench._compute
        self.n_jobs = 0

    async def call(self, job, *args, **kwargs):
        self.n_jobs += 1
        self._workbench = OpticsWorker(INSTRUMENT, self.compute)
        if self.forgets:
            self.model, self._arrays = ModelState, {}
        return await super().call(job, *args, **kwargs)


class Forgetful(Restarted):
    forgets = True


def played(name, seconds, compute, hands):
    """Return what followed from each event of a night, and the night.

    Sessions of the RTC have a number there, and no random name.
    """
    plan = PLANS[name]
    deeds = tuple(deed for deed in plan.deeds if deed[0] < seconds)
    kind = type("Night", (GoldenNight,), {"hands": staticmethod(hands)})
    with threadpool_limits(1):
        night = kind(replace(plan, seconds=seconds, deeds=deeds), OpticsWorker(INSTRUMENT, compute))
        night.play()
    text = json.dumps(night.recorded[1:])
    for k, name in enumerate(dict.fromkeys(re.findall(r'"session": "([0-9a-f]+)"', text))):
        text = text.replace(name, f"session-{k}")
    return [{name: entry.get(name) for name in COMPARED} for entry in json.loads(text)], night


@pytest.mark.parametrize(
    ("name", "seconds", "sampling"),
    [
        ("jump", 11.0, AT_WORK),
        ("acquire-ordered", 22.0, Sampling()),
        ("hold", 13.0, Sampling()),  # two refits, one of them sent
    ],
)
def test_a_night_in_which_the_worker_dies_before_every_job_is_the_same(name, seconds, sampling):
    compute = Compute(threads=1, cache=usual_folder(os.environ), sampling=sampling)
    expected, whole = played(name, seconds, compute, OwnHands)
    found, night = played(name, seconds, compute, Restarted)
    assert first_difference(found, expected) is None
    assert night.worker.n_jobs >= 12
    models = [replace(one.state.model, dither_session=None) for one in (night, whole)]
    assert models[0] == models[1] != ModelState()
    assert night.state.alpha.registration is not None


def test_a_worker_that_has_no_model_from_the_state_is_noticed():
    compute = Compute(threads=1, cache=usual_folder(os.environ), sampling=AT_WORK)
    expected, _ = played("jump", 5.0, compute, OwnHands)
    assert first_difference(played("jump", 5.0, compute, Forgetful)[0], expected) is not None
