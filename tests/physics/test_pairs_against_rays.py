"""D of a pair against rays from the star through the mirror, and spots transformed.

Nothing of the service's but the shapes of the mirror's own functions: rays are straight lines in
three dimensions, from the star to points of the pupil, and where they cross the mirror's altitude
says how high it stands there.
"""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.system import Pair
from service.model.interaction import InteractionModel
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from tests.support import systems
from tests.support.fft_spots import pushed

ACTUATORS = np.array([29, 41])
"""Near the middle of either mirror."""


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    text = systems.SYSTEM.replace('ground.toml"', 'ground.toml"\nstars = "direction and height"', 1)
    return systems.written(tmp_path_factory.mktemp("system"), text, n_subapertures=8)


def numbers(system, values, owner):
    """Return the numbers of a sensor or mirror by name, without units' names."""
    return {
        one.name.rsplit("_", 1)[0]: value
        for one, value in zip(system.parameters, values, strict=True)
        if one.owner == owner
    }


def crossed(pupil_m, star, altitude_m):
    """Return where the rays from the star to points of the pupil ``(n, 2)`` cross an altitude."""
    direction = np.array([star["star_x"], star["star_y"]])
    if np.isinf(star["star_height"]):
        return pupil_m + altitude_m * np.tan(direction)
    source = np.append(star["star_height"] * np.tan(direction), star["star_height"])
    ground = np.column_stack([pupil_m, np.zeros(len(pupil_m))])
    return (ground + (source - ground) * altitude_m / star["star_height"])[:, :2]


def back(points, place, shift):
    """Return the points that a place ``shift + magnification * R(rotation) p`` takes there."""
    cosine, sine = np.cos(place["rotation"]), np.sin(place["rotation"])
    turn = np.array([[cosine, -sine], [sine, cosine]]) * place["magnification"]
    return np.linalg.solve(turn, (points - shift).T).T


@pytest.mark.parametrize(("pair", "seed"), [(Pair(0, 0), 1), (Pair(0, 1), 2), (Pair(2, 1), 3)])
def test_the_matrix_of_a_pair_is_that_of_rays(system, pair, seed):
    """0.14 % is what spots on pixels leave of full lenslets; a shift of 0.02 leaves 2 %."""
    values = systems.moved(system, np.random.default_rng(seed), 0.15)
    alpha = Misregistration.from_vector(system.alphas(values)[system.pairs.index(pair)])
    sensor, mirror = (numbers(system, values, name) for name in system.names(pair))
    shift = (sensor["shift_x"], sensor["shift_y"])
    about = replace(system.instrument(pair), pupil_shift_subap=shift)
    basis = system.basis(pair).subset(ACTUATORS)
    model = InteractionModel(about, basis, pupil_sampling=6, detector_nodes=6)
    ours = model.interaction_matrix(alpha)

    placed = system.mirrors[pair.mirror]
    drawn = modal_basis(placed.instrument).subset(ACTUATORS)
    width_m = about.subaperture_m

    def opd_at(points):
        pupil_m = back(points, sensor, np.zeros(2)) * width_m
        met = crossed(pupil_m, sensor, placed.altitude_m)
        on_mirror = back(met, mirror, np.array([mirror["shift_x"], mirror["shift_y"]]))
        return drawn.render(on_mirror / width_m)

    brute = pushed(about, opd_at, shift, np.ones_like)
    light = model.sensor.at(shift).light.sum(axis=(1, 3))
    rows = np.tile((light > 0.999 * light.max())[model.valid], 2)
    theirs = brute[:, model.valid].reshape(len(ours), -1)[rows]
    error = np.linalg.norm(ours[rows] - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    assert np.all(error < 0.002), error
    aside = alpha.add_step(np.array([0.02, 0.0, 0.0, 0.0]))
    other = np.linalg.norm(model.interaction_matrix(aside)[rows] - theirs, axis=0)
    assert np.all(other > 0.015 * np.linalg.norm(theirs, axis=0))
