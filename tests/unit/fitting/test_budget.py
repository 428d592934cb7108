"""The power that a fit leaves over, divided among causes that were put into the matrix."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal.fitting.budget import Cause, advise_measurement
from pyrcal.fitting.fitted import Fit
from pyrcal.fitting.matrix import LIGHT_FOUND_WORDS, FitOptions
from pyrcal_studies.benches import BENCHES, fit_bench
from service.model.interaction import InteractionModel
from service.model.kinds import SlopeOrder
from service.model.modes import ModalBasis
from service.model.pupil import valid_subapertures
from service.model.slopes import SlopeRecipe
from tests.support.bench import ELSEWHERE, PLAIN, error, fit, instrument, matrix
from tests.support.numerics import small_basis

EXPLAIN = FitOptions(explain=True)
FOLDER = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))


def share(found: Fit, words: str) -> float:
    return sum(one.share for one in found.causes if words in one.words)


def bright_middle(about) -> np.ndarray:
    """Gain ``(n_valid,)`` of light that is half as bright at the edge of the pupil."""
    valid = valid_subapertures(about)
    y, x = (np.stack(np.nonzero(valid)) - (len(valid) - 1) / 2) / (len(valid) / 2)
    return 1.0 - 0.5 * (x**2 + y**2)


def test_uneven_light_is_found_in_the_matrix_and_explains_what_even_light_leaves():
    uneven = matrix(noise=0.05) * np.tile(bright_middle(instrument()), 2)[:, None]
    found, even = fit(uneven, options=EXPLAIN), fit(uneven, options=FitOptions(find_light=False))
    assert even.residual_fraction > 0.15
    assert found.residual_fraction < 0.06  # the noise alone is 0.05
    assert LIGHT_FOUND_WORDS in found.remarks
    assert np.all(np.abs(error(found)) < 3.0 * found.sigma)
    noise = (0.05 / even.residual_fraction) ** 2
    assert share(found, "uneven light") == pytest.approx(1.0 - noise, abs=0.05)
    assert share(found, "white noise") == pytest.approx(noise, abs=0.05)


def test_white_noise_alone_is_found_as_noise_and_no_light_is_fitted():
    found = fit(matrix(noise=0.3), options=EXPLAIN)
    assert found.gain_map is None
    assert share(found, "white noise") > 0.9
    assert share(found, "mirror shape") < 0.03


def test_modes_with_other_strokes_are_found_as_another_mirror_shape():
    basis = small_basis()
    assert isinstance(basis, ModalBasis)
    rng = np.random.default_rng(3)
    strokes = basis.mode_to_actuator
    other = strokes + 0.2 * strokes.std(axis=0) * rng.normal(size=strokes.shape)
    wrong = replace(basis, mode_to_actuator=other, coefficients=basis.surface.coefficients(other))
    found = fit(matrix(basis=wrong), options=EXPLAIN)
    assert found.residual_fraction > 0.05
    assert share(found, "mirror shape") > 0.6
    assert share(found, "white noise") < 0.15


def test_the_image_with_fringes_is_named_with_its_half():
    about = replace(
        instrument(),
        slopes=SlopeRecipe(order=SlopeOrder.IMAGES, orientation=PLAIN),
    )
    exact = InteractionModel(about, small_basis()).interaction_matrix(ELSEWHERE).astype(float)
    valid = valid_subapertures(about)
    x = np.nonzero(valid)[1] - (len(valid) - 1) / 2
    images = exact.reshape(4, -1, exact.shape[1])
    fringes = 0.4 * np.sin(np.arange(len(x)) * 2.0)[:, None] * (x < 0)[:, None]
    images[2] += fringes * images[2].std(axis=0) * np.array([1.0, -1.0] * 20)
    found = fit(exact, about, options=EXPLAIN)
    assert share(found, "the image at -x +y unlike the others, mostly in its left half") > 0.3
    assert sum(round(100.0 * one.share) for one in found.causes) == 100


def test_hardly_anything_left_over_has_no_causes():
    found = fit(matrix(), options=EXPLAIN)
    assert found.residual_fraction < 0.02
    assert found.causes == ()


def test_shares_add_up_to_one_and_what_to_measure_next_makes_half():
    def cause(words: str, share: float) -> Cause:
        return Cause(words=words, share=share, sigma=0.1, remedy=f"measure {words}")

    listed = (cause("light", 0.3), cause("shape", 0.25), cause("noise", 0.1))
    rest = cause("unexplained", 0.35)
    assert advise_measurement((*listed, rest)) == (
        "55% of the power left over comes from light (30%) and shape (25%): measure light; "
        "measure shape"
    )
    assert advise_measurement((listed[0], cause("noise", 0.05), rest)) == (
        "30% of the power left over has a known cause, which is not half: measure light"
    )
    assert advise_measurement(()) == ""
    found = fit(matrix(noise=0.2), options=EXPLAIN)
    assert sum(one.share for one in found.causes) == pytest.approx(1.0)
    # as they are shown, in whole per cents
    assert sum(int(f"{one.share:.0%}"[:-1]) for one in found.causes) == 100


@pytest.mark.skipif(not (FOLDER / "papyrus").is_dir(), reason="data of PAPYRUS are not here")
@pytest.mark.long
@pytest.mark.timeout(600)
def test_papyrus_leaves_29_percent_with_the_light_that_its_matrix_shows():
    found = fit_bench(BENCHES[0], FOLDER)
    assert found.residual_fraction < 0.29
    assert share(found, "uneven light") == pytest.approx(0.27, abs=0.03)
    assert share(found, "mirror shape") > 0.15
