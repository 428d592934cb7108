"""Where everything is, from α of all pairs: recovery, σ, and what cannot be seen."""

import numpy as np
import pytest

from pyrcal.fitting.system_fit import fit_system
from tests.support import systems

SIGMA = np.array([0.01, 0.01, np.deg2rad(0.05), 5e-4])

ONE_HEIGHT = systems.SYSTEM.replace(
    "star_arcsec = [-10.0, -15.0]", "star_arcsec = [-10.0, -15.0]\nstar_height_m = 90e3"
)
"""Three laser stars."""

THREE_MIRRORS = f"""{ONE_HEIGHT}
[[mirrors]]
name = "dm3"
instrument = "high.toml"
altitude_m = 4000.0
"""


def asked(text, stars="known"):
    return text.replace('"ground.toml"', f'"ground.toml"\nstars = "{stars}"', 1)


@pytest.fixture
def system(request, tmp_path):
    return systems.written(tmp_path, request.param)


def covariances(system, sigma=SIGMA):
    return np.tile(np.diag(sigma**2), (len(system.pairs), 1, 1))


def free_of(system):
    return np.array([parameter.free for parameter in system.parameters])


def far(system, found, values):
    """Return how far numbers are from what they should be, subapertures."""
    free = free_of(system)
    unit = np.array([parameter.subap for parameter in system.parameters])
    return (found[free] - values[free]) / unit[free]


FIXED = systems.SYSTEM.replace('name = "dm1"', 'name = "dm1"\nfixed = true')


@pytest.mark.parametrize("system", [FIXED], indirect=True)
def test_what_is_seen_is_found_exactly_without_noise(system):
    values = systems.moved(system, np.random.default_rng(1))
    found = fit_system(system, system.alphas(values), covariances(system))
    assert found.unseen == ()
    assert far(system, found.values, values) == pytest.approx(0.0, abs=1e-9)
    assert found.chi2 == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("system", [asked(THREE_MIRRORS, "direction")], indirect=True)
def test_without_noise_every_pair_is_explained_though_not_all_is_seen(system):
    values = systems.moved(system, np.random.default_rng(1))
    found = fit_system(system, system.alphas(values), covariances(system))
    assert len(found.unseen) == 4
    assert np.abs(found.pulls).max() < 1e-6


@pytest.mark.parametrize("system", [FIXED, asked(THREE_MIRRORS)], indirect=True)
def test_errors_are_as_large_as_sigma_says(system):
    """χ² of the errors over 200 draws: of the mean of n numbers squared 1 σ is sqrt(2 / n)."""
    rng, errors, left = np.random.default_rng(2), [], []
    free = free_of(system)
    unit = np.array([parameter.subap for parameter in system.parameters])[free]
    for _ in range(200):
        values = systems.moved(system, rng, 0.05)
        noisy = system.alphas(values) + SIGMA * rng.normal(size=(len(system.pairs), 4))
        found = fit_system(system, noisy, covariances(system))
        scaled = found.covariance[np.ix_(free, free)] / np.outer(unit, unit)
        variance, axes = np.linalg.eigh(scaled)
        seen = variance > 1e-12
        errors.append((axes.T @ far(system, found.values, values))[seen] / np.sqrt(variance[seen]))
        left.append(found.chi2)
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=4 * np.sqrt(2 / np.size(errors)))
    expected = found.n_free
    assert np.mean(left) == pytest.approx(expected, abs=4 * np.sqrt(2 * expected / 200))


@pytest.mark.parametrize("system", [asked(THREE_MIRRORS)], indirect=True)
def test_what_is_not_seen_stays_nearest_to_the_file(system):
    """A shift of everything together is not found; it is shared by nobody."""
    values = system.nominal.copy()
    for number, mirror in enumerate(system.mirrors):
        values[system.of_mirror(number)][0] += 0.4 * (1 - mirror.altitude_m / 90e3)
    for number, sensor in enumerate(system.sensors):
        turned = sensor.place.turn * 0.5
        values[system.of_sensor(number)][:2] -= [turned.real, turned.imag]
    assert np.abs(system.alphas(values) - system.alphas(system.nominal)).max() < 1e-12
    found = fit_system(system, system.alphas(values), covariances(system))
    assert far(system, found.values, system.nominal) == pytest.approx(0.0, abs=1e-9)
    (words,) = found.unseen
    assert words.startswith("the common shift of all sensors and mirrors")
    shares = dict(zip(system.parameters, found.unseen_share, strict=True))
    marked = {(one.owner, one.name) for one, share in shares.items() if share > 0.05}
    assert ("dm1", "shift_x_m") in marked
    assert ("dm1", "rotation_deg") not in marked


@pytest.mark.parametrize(
    ("system", "beginnings"),
    [
        (asked(ONE_HEIGHT), ["the common shift"]),
        (asked(systems.SYSTEM), []),  # the cone of one kind of star tells, a natural star has none
        (asked(FIXED), []),
        (
            asked(THREE_MIRRORS, "direction"),
            [
                "the common shift",
                "the common direction of all stars",
                "the common rotation of all sensors, mirrors and stars",
                "the common magnification of all sensors, mirrors and stars",
            ],
        ),
        (
            asked(ONE_HEIGHT.replace("altitude_m = 9000.0\n", ""), "direction"),
            [
                "the star of lgs1",
                "the star of lgs2",
                "the star of ngs",
                "the common shift",
                "the common rotation",
                "the common magnification",
            ],
        ),
        (
            asked(ONE_HEIGHT.replace('name = "dm1"', 'name = "dm1"\naltitude_m = 9000.0\n'
                  'instrument = "high.toml"'), "direction and height"),
            [
                "the star's direction and the shift of lgs1: they separate only with mirrors at",
                "the star's height and the magnification of lgs1",
                "the star's direction and the shift of lgs2",
                "the star's height and the magnification of lgs2",
                "the star's direction and the shift of ngs",
                "the star's height and the magnification of ngs",
                "the common shift",
                "the common rotation",
                "the common magnification",
            ],
        ),
    ],
    indirect=["system"],
)  # fmt: skip
def test_directions_that_are_not_seen_have_names(system, beginnings):
    found = fit_system(system, system.alphas(system.nominal), covariances(system))
    assert len(found.unseen) == len(beginnings), found.unseen
    for words, beginning in zip(found.unseen, beginnings, strict=True):
        assert words.startswith(beginning)


@pytest.mark.parametrize("system", [systems.SYSTEM], indirect=True)
def test_a_direction_without_a_name_is_told_by_its_largest_parts(system):
    """Only one pair is known: the others' mirrors and sensors are not seen at all."""
    alphas = system.alphas(system.nominal)
    alphas[1:] = np.nan
    found = fit_system(system, alphas, covariances(system))
    assert any(words.startswith("together, in subapertures: ") for words in found.unseen)
    assert np.isnan(found.misfit[1:]).all()
    assert found.n_free == 0
    assert found.probability == 1.0
