"""The margin of the matrix in use is worked out again only when something has moved."""

from dataclasses import replace

import numpy as np
import pytest

from service.model.misregistration import Misregistration
from service.worker import InUse, OpticsWorker
from tests.unit.runtime.small import COMPUTE, N_CONTROLLED, SIGMA, loop_settings, small_instrument

ALPHA = Misregistration(shift_x_subap=0.05, rotation_rad=0.002)


@pytest.fixture(scope="module")
def bench():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture
def looks(bench, monkeypatch):
    """What the bench worked out, in order."""
    done = []
    for name in ("judge", "assess"):
        work = getattr(bench, name)
        monkeypatch.setattr(
            bench, name, lambda *a, name=name, work=work: done.append(name) or work(*a)
        )
    monkeypatch.setattr(bench, "_margin", None)
    return done


@pytest.fixture(scope="module")
def question(bench):
    loop = loop_settings()
    return InUse(
        matrix=bench.make(Misregistration(), np.diag(SIGMA**2), loop, 0.95).matrix,
        alpha=ALPHA,
        covariance=np.diag(SIGMA**2),
        loop=loop,
        bound=0.95,
        optical_gain=np.full(90, 0.6),
        magnitude=8.0,
    )


def test_a_margin_says_what_the_gate_and_the_expected_gain_say(bench, looks, question):
    found = bench.margin(question)
    assert looks == ["judge", "assess"]
    expected = bench.judge(
        question.matrix, ALPHA, question.covariance, question.loop, question.bound
    )
    assert found.verdict == expected
    assert found.alpha == ALPHA
    assert found.gains == tuple(question.loop.gains)
    np.testing.assert_array_equal(found.sigma, SIGMA)


def test_nothing_is_worked_out_again_while_nothing_has_moved(bench, looks, question):
    first = bench.margin(question)
    for share in (-0.4, 0.2, 0.4):
        alpha = Misregistration.from_vector(ALPHA.vector + share * SIGMA)
        again = replace(question, alpha=alpha, matrix=question.matrix.copy(), magnitude=8.05)
        assert bench.margin(again) is first
    assert looks == ["judge", "assess"]


def test_what_creeps_is_looked_at_again_from_where_it_was_last(bench, looks, question):
    """Each step alone is no move: the distance counts from the last look, not from the last ask."""
    bench.margin(question)
    for k in range(1, 5):
        step = np.array([0.004 * k, 0, 0, 0])
        bench.margin(replace(question, alpha=Misregistration.from_vector(ALPHA.vector + step)))
    assert len(looks) > 2


MOVED = {
    "alpha": lambda q: replace(q, alpha=Misregistration(shift_x_subap=0.08, rotation_rad=0.002)),
    "a larger sigma": lambda q: replace(q, covariance=1.7 * q.covariance),
    "a much smaller sigma": lambda q: replace(q, covariance=0.05 * q.covariance),
    "gains": lambda q: replace(q, loop=replace(q.loop, gains=1.1 * q.loop.gains)),
    "one gain": lambda q: replace(
        q, loop=replace(q.loop, gains=q.loop.gains * (1 + np.eye(N_CONTROLLED)[3]))
    ),
    "leak": lambda q: replace(q, loop=replace(q.loop, leak=0.97)),
    "delay": lambda q: replace(q, loop=replace(q.loop, delay_frames=2.2)),
    "optical gain": lambda q: replace(q, loop=replace(q.loop, optical_gain=0.7)),
    "modes that hold": lambda q: replace(q, loop=replace(q.loop, n_holding=N_CONTROLLED)),
    "bound": lambda q: replace(q, bound=0.9),
    "star": lambda q: replace(q, magnitude=9.0),
    "no star": lambda q: replace(q, magnitude=None),
    "sky": lambda q: replace(q, optical_gain=1.1 * q.optical_gain),
    "matrix": lambda q: replace(q, matrix=q.matrix * np.float32(1.001)),
}


@pytest.mark.parametrize("what", MOVED)
def test_what_matters_is_looked_at_again(bench, looks, question, what):
    bench.margin(question)
    bench.margin(MOVED[what](question))
    assert looks == ["judge", "assess"] * 2
