from dataclasses import replace

import numpy as np
import pytest

from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.pupil import instrument_pupil
from service.model.surface import ThinPlate
from sim_rtc.telescope.imperfections import Imperfections
from sim_rtc.telescope.linear import LinearPlant, optical_gain
from sim_rtc.telescope.mirror import MirrorFaults
from sim_rtc.telescope.plant import light_unevenly

ALIGNED = Misregistration()
TURNED = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.01, magnification=1.004
)
PERFECT = Imperfections(
    unevenness=0.0, position_error=0.0, lowest_optical_gain=1.0, highest_optical_gain=1.0
)


@pytest.fixture(scope="module")
def plant(small_instrument, small_basis):
    return LinearPlant(small_instrument, small_basis, rng=np.random.default_rng(1))


def distance(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def test_turbulence_the_mirror_can_make_is_seen_as_the_mirror_is(plant):
    optics = plant.optics(TURNED)
    seen = optics.slopes_per_phase @ optics.opd_per_command
    assert distance(seen, optics.slopes_per_command) < 1e-5


def test_the_optical_gain_lowers_every_mode_as_told(small_instrument, small_basis):
    def columns(imperfections):
        plant = LinearPlant(
            small_instrument,
            small_basis,
            rng=np.random.default_rng(1),
            imperfections=imperfections,
        )
        return plant.optics(TURNED).slopes_per_command

    full = columns(replace(Imperfections(), lowest_optical_gain=1.0, highest_optical_gain=1.0))
    ratio = np.linalg.norm(columns(Imperfections()), axis=0) / np.linalg.norm(full, axis=0)
    np.testing.assert_allclose(ratio, optical_gain(40, Imperfections()), rtol=1e-5)
    assert ratio[0] == pytest.approx(0.6)
    assert ratio[-1] == pytest.approx(0.9)


def test_a_perfect_plant_is_the_services_model_but_for_the_sampling(small_instrument, small_basis):
    plant = LinearPlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=PERFECT
    )
    model = InteractionModel(small_instrument, small_basis)
    # q = 3 against q = 4 is 0.5 to 0.9 % (model.md); modes here are of low order.
    for alpha in (ALIGNED, TURNED):
        matrix = plant.optics(alpha).slopes_per_command
        assert distance(model.interaction_matrix(alpha), matrix) < 0.01
    assert distance(model.interaction_matrix(ALIGNED), matrix) > 0.03


def test_the_real_plant_is_not_the_services_model(plant, small_instrument, small_basis):
    model = InteractionModel(small_instrument, small_basis).interaction_matrix(TURNED)
    matrix = plant.optics(TURNED).slopes_per_command
    scale = (model * matrix).sum(axis=0) / (model * model).sum(axis=0)
    assert 0.005 < distance(model * scale, matrix) < 0.10


def test_the_telescope_as_stop_moves_the_mirror_instead_of_the_images(
    small_instrument, small_basis
):
    instrument = replace(small_instrument, stop=Stop.TELESCOPE)
    plant = LinearPlant(
        instrument, small_basis, rng=np.random.default_rng(1), imperfections=PERFECT
    )
    moved = plant.optics(TURNED)
    np.testing.assert_array_equal(moved.images, plant.optics(ALIGNED).images)
    model = InteractionModel(instrument, small_basis).interaction_matrix(TURNED)
    assert distance(model, moved.slopes_per_command) < 0.01


def test_the_illumination_is_uneven_by_ten_per_cent(small_instrument):
    pupil = instrument_pupil(small_instrument, 4)
    lit = light_unevenly(pupil, 0.10, np.random.default_rng(3))
    flux = (lit.amplitude[pupil.lit] / pupil.amplitude[pupil.lit]) ** 2
    assert np.abs(flux - 1).max() == pytest.approx(0.10)
    assert flux @ pupil.weights == pytest.approx(1.0)
    np.testing.assert_array_equal(lit.lit, pupil.lit)


def test_a_dead_actuator_is_where_the_others_bend_the_plate(small_instrument, small_basis):
    """A thin plate without one of its supports: what the service's drawing makes of the others."""
    held = np.arange(len(small_instrument.mirror.positions_m)) != 30
    mirror = small_instrument.mirror
    positions = mirror.positions_m / small_instrument.subaperture_m
    plate = ThinPlate(positions[held])
    faulty = LinearPlant(
        small_instrument,
        small_basis,
        rng=np.random.default_rng(1),
        imperfections=PERFECT,
        faults=MirrorFaults(dead=(30,)),
    )
    points = faulty.points_m / small_instrument.subaperture_m
    weights = plate.coefficients(small_basis.mode_to_actuator[held])
    expected = plate.basis(points) @ weights
    found = faulty.optics(ALIGNED).opd_per_command
    assert distance(found, expected) < 1e-5
    assert distance(found, small_basis.render(points)) > 0.01


def test_a_stuck_actuator_is_in_the_wavefront_and_follows_no_mode(small_instrument, small_basis):
    faulty = LinearPlant(
        small_instrument,
        small_basis,
        rng=np.random.default_rng(1),
        imperfections=PERFECT,
        faults=MirrorFaults(stuck=((30, 1e-7),)),
    )
    optics = faulty.optics(ALIGNED)
    at = np.argmin(np.hypot(*(faulty.points_m - small_instrument.mirror.positions_m[30]).T))
    assert optics.stuck_opd_m[at] == pytest.approx(1e-7, rel=0.05)
    assert np.argmax(optics.stuck_opd_m) in np.flatnonzero(
        np.hypot(*(faulty.points_m - faulty.points_m[at]).T) < 0.2
    )
    healthy = small_basis.render(faulty.points_m / small_instrument.subaperture_m)
    assert np.abs(optics.opd_per_command[at]).max() < 0.1 * np.abs(healthy[at]).max()
    near = Misregistration(shift_x_subap=0.02)
    halfway = optics.towards(faulty.optics(near), 0.5)
    assert halfway.stuck_opd_m.max() == pytest.approx(1e-7, rel=0.05)


def test_a_small_drift_is_linear_between_exact_optics(plant):
    near = Misregistration.from_vector(TURNED.vector + np.array([0.02, 0.01, 2e-4, 2e-4]))
    middle = Misregistration.from_vector((TURNED.vector + near.vector) / 2)
    blend = plant.optics(TURNED).towards(plant.optics(near), 0.5)
    exact = plant.optics(middle)
    np.testing.assert_allclose(blend.alpha.vector, middle.vector)
    # Half a step h of a wave of two grid points, 4 pi per subaperture: (4 pi h)² / 2 at the worst.
    worst = (4 * np.pi * 0.011) ** 2 / 2
    assert distance(blend.slopes_per_phase, exact.slopes_per_phase) < worst
    assert distance(blend.slopes_per_command, exact.slopes_per_command) < worst / 20
