"""A stretched mirror through the service: worker, filter, matrices, what is shown and kept."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.campaign.golden_nights import SETTINGS
from pyrcal_studies.campaign.observatory import Observatory, latencies_of
from service.archive.serialisation import TrackingFile
from service.config import load_settings
from service.instrument import load_instrument
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from service.runtime.worker.records import Compute
from service.tracking.resume import saved_of
from tests.support.small import COMPUTE, SIGMA, conditions, loop_settings, small_instrument
from tests.support.workbench import ALPHA, dithered_window, open_loop

FILE = Path(__file__).parents[2] / "data" / "lenslets.toml"
STRETCHES = np.array([0.0185, -0.003])
"""GPAO's largest, and a little beside it."""

TRUE = ALPHA.with_anamorphosis(STRETCHES)


@pytest.fixture(scope="module")
def plain():
    return OpticsWorker(small_instrument(), COMPUTE)


@pytest.fixture(scope="module")
def following():
    return OpticsWorker(small_instrument(), replace(COMPUTE, anamorphosis=True))


def fitted(worker, window):
    loop = loop_settings()
    made = worker.make(conditions(ALPHA, np.diag(SIGMA**2), loop, 0.95))
    return worker.fit(window, open_loop(made.matrix), ALPHA)


def test_a_window_gives_back_the_anamorphosis_it_was_made_with(plain, following):
    """And a window that is not asked for it takes it for a magnification and a shift."""
    window = dithered_window(plain, TRUE, noise=3e-3)
    found = fitted(following, window)
    error = np.concatenate([found.alpha.vector, found.alpha.stretches])
    error -= np.concatenate([TRUE.vector, STRETCHES])
    assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(found.with_stretches)) + 2e-5)
    unasked = fitted(plain, window)
    assert unasked.with_stretches is None
    assert np.abs(unasked.alpha.vector - TRUE.vector).max() > 10.0 * np.abs(error).max()


def test_where_it_is_nought_the_four_are_hardly_less_certain(plain, following):
    window = dithered_window(plain, ALPHA, noise=3e-3)
    with_it, without = fitted(following, window), fitted(plain, window)
    assert np.all(with_it.sigma < 1.5 * without.sigma)


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Twelve seconds beside a telescope that is stretched, of whose file nobody has said so."""
    text = FILE.read_text(encoding="utf-8")
    path = tmp_path_factory.mktemp("stretched") / "lenslets.toml"
    path.write_text(
        text.replace("[mirror]\n", f"[mirror]\nnominal_anamorphosis = {STRETCHES.tolist()}\n")
    )
    settings = load_settings(None, {}, {**SETTINGS, "tracking.anamorphosis": True})
    night = Observatory(
        [
            f"--instrument={path}",
            "--alpha=0.18,-0.12,0.5,1.004",
            "--rate=500",
            "--n-controlled=60",
            "--seed=3",
            "--mag=8",
        ],
        policy_of(settings),
        Mode.AUTO,
        OpticsWorker(load_instrument(FILE), Compute(threads=1, anamorphosis=True)),
        latencies=latencies_of(1.0),
        with_poles=False,
    )
    night.advance(16.0)
    return night


def test_the_filter_follows_it_beside_the_four(night):
    known = night.state.alpha.registration
    assert known.n_windows >= 2
    assert np.all(np.abs(known.alpha.stretches - STRETCHES) < 4.0 * known.stretches.sigma)
    assert np.all(known.stretches.sigma < 0.003)
    true = [0.18, -0.12, np.deg2rad(0.5), 1.004]
    assert np.all(np.abs(known.alpha.vector - true) < 3.5 * known.sigma)


def test_the_matrix_in_use_was_made_with_it(night):
    (used,) = [r for r in night.state.matrices.reconstructors if r.state is MatrixState.APPLIED]
    assert np.abs(np.array(used.alpha.anamorphosis) - STRETCHES).max() < 0.005
    assert used.gate.n_points == 13, "at both ends of what is not known of it, too"


def test_the_next_service_takes_it_over(night, tmp_path):
    file = TrackingFile(tmp_path / "tracking.json")
    file.write(saved_of(night.state, night.dome.now_ns))
    known, again = night.state.alpha.registration, file.read().registration
    assert again.alpha == known.alpha
    np.testing.assert_array_equal(again.stretches.covariance, known.stretches.covariance)
    np.testing.assert_array_equal(again.stretches.shared, known.stretches.shared)
