import itertools

import numpy as np
import pytest

from service.control.dither import compute_information, select_informative_modes
from service.model.interaction import Linearisation
from service.model.misregistration import Misregistration

RNG = np.random.default_rng(3)
WANTED = np.array([0.003, 0.003, 1e-4, 3e-4])


@pytest.fixture(scope="module")
def linearisation():
    return Linearisation(
        alpha=Misregistration(),
        matrix=RNG.normal(size=(60, 12)).astype(np.float32),
        derivatives=RNG.normal(size=(4, 60, 12)).astype(np.float32),
    )


def worst(found, modes):
    covariance = np.linalg.inv(found[list(modes)].sum(axis=0))
    return (np.diag(covariance) / WANTED**2).max()


def test_information_is_that_of_a_fit_with_the_modes_gain_free(linearisation):
    found = compute_information(linearisation)
    for mode in (0, 7):
        regressors = np.column_stack(
            [*linearisation.derivatives[:, :, mode], linearisation.matrix[:, mode]]
        ).astype(float)
        covariance = np.linalg.inv(regressors.T @ regressors)
        np.testing.assert_allclose(np.linalg.inv(found[mode]), covariance[:4, :4], rtol=1e-5)


def test_no_exchange_of_one_mode_improves_the_chosen_set(linearisation):
    found = compute_information(linearisation)
    chosen = select_informative_modes(found, range(12), 4, WANTED)
    assert len(set(chosen)) == 4
    for place, other in itertools.product(range(4), set(range(12)) - set(chosen)):
        exchanged = [*chosen[:place], other, *chosen[place + 1 :]]
        assert worst(found, exchanged) >= worst(found, chosen) * (1 - 1e-5)


def test_only_candidates_are_chosen(linearisation):
    assert set(
        select_informative_modes(compute_information(linearisation), range(5, 30), 3, WANTED)
    ) <= set(range(5, 12))


def test_fewer_candidates_than_wanted_are_all_taken(linearisation):
    assert select_informative_modes(
        compute_information(linearisation), range(9, 40), 4, WANTED
    ) == (9, 10, 11)


def test_what_is_wanted_decides_which_modes_tell_most(linearisation):
    found = compute_information(linearisation)
    only_rotation = select_informative_modes(found, range(12), 1, np.array([1e3, 1e3, 1e-4, 1e3]))
    variances = [np.linalg.inv(found[mode])[2, 2] for mode in range(12)]
    assert only_rotation == (int(np.argmin(variances)),)
