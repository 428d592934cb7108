"""``pyrcal.fit`` of arrays: the same as of a file, and what it refuses."""

from functools import cache

import numpy as np
import pytest

import pyrcal
from pyrcal.fitting.fit_file import fit_file
from service.errors import MatrixError
from service.model.misregistration import Misregistration
from service.model.pupil import Illumination
from tests.support.bench import ELSEWHERE, error, instrument, matrix

MODES = np.arange(10, 40)


@cache
def fitted():
    columns = matrix(noise=0.05)[:, MODES]
    return pyrcal.fit(instrument(), columns, modes=MODES.tolist(), noise=np.full(30, 0.01))


def test_a_fit_of_an_array_is_that_of_its_file(tmp_path):
    path = tmp_path / "im.npy"
    np.save(path, matrix(noise=0.05))
    of_file = fit_file(instrument(), str(path), pyrcal.FitOptions()).fit
    of_array = pyrcal.fit(instrument(), matrix(noise=0.05), threads=1)
    np.testing.assert_allclose(of_array.alpha.vector, of_file.alpha.vector, atol=1e-9)
    np.testing.assert_allclose(of_array.covariance, of_file.covariance, rtol=1e-6)
    assert of_array.verdict == of_file.verdict
    assert len(of_array.alternatives) == len(of_file.alternatives)


@pytest.mark.parametrize(("uneven", "said"), [(0.6, True), (0.0, False)])
def test_a_mean_frame_in_the_file_is_mentioned_where_its_light_would_lower_sigma(uneven, said):
    across = np.linspace(-7.0, 7.0, 57)
    lamp = Illumination(
        coordinates=across, intensity=1.0 + uneven * np.sin(0.4 * across) + 0.0 * across[:, None]
    )
    columns = matrix(illumination=lamp if said else None, noise=0.05)
    frame = np.full((40, 40), 900.0)
    found = pyrcal.fit(instrument(), columns, flux_frame=frame, threads=1)
    assert any("out of flux_frame" in one for one in found.remarks) is said
    mask = np.ones((40, 40))
    found = pyrcal.fit(instrument(), columns, flux_frame=mask, threads=1)
    assert not any("out of flux_frame" in one for one in found.remarks)
    assert not any("flux_frame" in one for one in pyrcal.fit(instrument(), columns).remarks)


def test_columns_of_some_modes_are_named_by_their_indices():
    np.testing.assert_array_equal(fitted().modes, MODES)
    assert np.all(np.abs(error(fitted(), ELSEWHERE)) < 4.0 * fitted().sigma)


def test_numbers_leave_in_degrees_with_their_names():
    found = fitted()
    assert found.alpha.rotation_deg == pytest.approx(np.rad2deg(found.alpha.rotation_rad))
    sigma = found.sigma_to_boundary()
    assert sigma["rotation_deg"] == pytest.approx(np.rad2deg(found.sigma[2]))
    assert sigma["shift_x_subap"] == pytest.approx(found.sigma[0])
    assert list(sigma) == list(Misregistration().to_boundary())


def test_a_name_or_a_path_stands_for_an_instrument():
    small = "tests/system/small.toml"
    about = pyrcal.load_instrument(small)
    given = pyrcal.interaction_matrix(small)
    np.testing.assert_array_equal(given, pyrcal.interaction_matrix(about))
    found = pyrcal.fit(small, given)
    assert np.all(np.abs(found.alpha.vector - about.start.vector) < 3.0 * found.sigma)


def test_it_is_drawn_with_and_without_its_instrument(tmp_path):
    pytest.importorskip("matplotlib")
    for about in (None, instrument()):
        fitted().plot(about).savefig(tmp_path / "fit.png")
        assert (tmp_path / "fit.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    ("values", "more", "text"),
    [
        (np.ones((3, 4), complex), {}, "matrix: found complex128"),
        (np.ones(7), {}, "matrix: found float64 of shape"),
        ([], {}, "matrix: found float64 of shape"),
        (np.ones((224, 3)), {"modes": [0, 1]}, "modes: found 2 numbers"),
        (np.ones((224, 3)), {"modes": [0, 1.5, 2]}, "modes: found 3 numbers"),
        (np.ones((224, 3)), {"modes": [0, -1, 2]}, "modes: found 3 numbers"),
        (np.ones((224, 3)), {"noise": [0.1]}, "noise: found 1 numbers"),
        (np.ones((3, 8, 8)), {}, "detector frames"),
        (np.ones((3, 3)), {}, "matrix: found shape"),
        (np.full((224, 12), np.nan), {}, "matrix: "),
    ],
)
def test_what_cannot_be_fitted_is_refused(values, more, text):
    with pytest.raises(MatrixError) as error:
        pyrcal.fit(instrument(), values, **more)
    assert text in str(error.value)


def test_a_mean_frame_without_counts_leaves_the_unit_of_the_commands_open():
    light = np.random.default_rng(5).uniform(0.8, 1.2, (40, 40))
    even = np.pad(np.full((20, 20), 5e3), 10)
    for counts in (light, even):
        lit = pyrcal.fit(instrument(), matrix(), flux_frame=counts, threads=1).stroke
        assert lit.metres_per_unit == pytest.approx(1.0, abs=3.0 * lit.sigma)
    mask = (even > 0.0).astype(float)
    for other in (mask, 255.0 * mask, light / light.max()):
        found = pyrcal.fit(instrument(), matrix(), flux_frame=other, threads=1).stroke
        assert found.metres_per_unit is None
        assert "no mean frame in counts" in found.condition
