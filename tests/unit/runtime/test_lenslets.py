"""A Shack-Hartmann through everything: a fit, the simulated telescope, the service beside it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.matrix import fit_matrix
from pyrcal_studies.campaign.golden_nights import SETTINGS, WORDS
from pyrcal_studies.campaign.observatory import Observatory, latencies_of
from service.config import load_settings
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE, Misregistration
from service.model.modes import modal_basis
from service.records.products import MatrixState
from service.records.state import Mode
from service.runtime.policy import policy_of
from service.runtime.worker import OpticsWorker
from service.runtime.worker.records import Compute
from service.tracking.validity import Validity
from sim_rtc.telescope.imperfections import SETS
from sim_rtc.telescope.linear import LinearPlant

FILE = Path(__file__).parents[2] / "data" / "lenslets.toml"
ALPHA = Misregistration(
    shift_x_subap=0.18, shift_y_subap=-0.12, rotation_rad=np.deg2rad(0.5), magnification=1.004
)


@pytest.fixture(scope="module")
def lenslets():
    return load_instrument(FILE)


def test_a_matrix_without_noise_of_another_grid_is_fitted(lenslets):
    """The plant has 4 points in a subaperture, the model 3, and its own quadrature."""
    basis, exact = (
        modal_basis(lenslets),
        replace(SETS["ideal"], lowest_optical_gain=1.0, highest_optical_gain=1.0),
    )
    plant = LinearPlant(lenslets, basis, rng=np.random.default_rng(1), imperfections=exact)
    measured = plant.optics(ALPHA).slopes_per_command.astype(np.float64)
    found = fit_matrix(lenslets, Reference(matrix=measured), basis=basis)
    assert found.accepted, found.verdict
    assert found.residual_fraction < 0.03
    error = np.abs(found.alpha.vector - ALPHA.vector)
    assert np.all(error < [0.008, 0.008, np.deg2rad(0.02), 1e-3]), error


def test_the_service_finds_it_in_a_closed_loop_and_swaps_the_matrix(lenslets):
    words = [f"--instrument={FILE}" if word.startswith("--instrument") else word for word in WORDS]
    words = [word for word in words if not word.startswith("--alpha")]
    night = Observatory(
        [*words, "--alpha=0.18,-0.12,0.5,1.004"],
        policy_of(load_settings(None, {}, dict(SETTINGS))),
        Mode.AUTO,
        OpticsWorker(lenslets, Compute(threads=1)),
        latencies=latencies_of(1.0),
        with_poles=False,
    )
    night.advance(12.0)
    alpha = night.state.alpha.registration
    assert alpha is not None
    assert alpha.validity.level is Validity.FRESH
    error = np.abs(alpha.alpha.vector - ALPHA.vector)
    assert np.all(error < [0.03, 0.03, np.deg2rad(0.1), 5e-3]), error
    in_use = [r for r in night.state.matrices.reconstructors if r.state is MatrixState.APPLIED]
    assert [r.id.startswith("cm-") for r in in_use] == [True]
    assert night.dome.moments[-1].wavefront_nm < 300.0


@pytest.mark.long
def test_on_spots_with_noise_alpha_is_followed_a_jump_is_found_and_sigma_is_honest(lenslets):
    """Photons and read noise on pixels, another mirror, another grid, uneven light."""
    night = Observatory(
        [
            f"--instrument={FILE}",
            "--plant=diffractive",
            "--alpha=0.18,-0.12,0.5,1.004",
            "--jump=12:0.25,-0.1,0,0",
            "--mag=8",
            "--rate=500",
            "--n-controlled=60",
            "--seed=1",
        ],
        policy_of(load_settings(None, {}, {"dither.longest_pause_s": 0.0}), lenslets),
        Mode.AUTO,
        OpticsWorker(lenslets, Compute(threads=1)),
        latencies=latencies_of(1.0),
        with_poles=False,
    )
    far = []
    for seconds in (11.0, 19.0):
        night.advance(seconds)
        alpha = night.state.alpha.registration
        error = alpha.alpha.vector - night.dome.computer._optics.alpha.vector
        sigma = night.glances[-1].sigma
        far += list(error / sigma)
        assert np.all(np.abs(error) < [0.05, 0.05, np.deg2rad(0.25), 6e-3]), error * BOUNDARY_SCALE
        assert np.all(sigma < [0.04, 0.04, np.deg2rad(0.2), 6e-3]), sigma * BOUNDARY_SCALE
    assert np.abs(far).max() < 3.0
    in_use = [r for r in night.state.matrices.reconstructors if r.state is MatrixState.APPLIED]
    assert [r.id.startswith("cm-") for r in in_use] == [True]
