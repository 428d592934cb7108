from concurrent.futures import Executor, Future
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from service.errors import ModelError
from service.model.interaction import InteractionModel
from service.model.kinds import KarhunenLoeve, Stop
from service.model.misregistration import Misregistration
from service.model.pupil import valid_subapertures
from service.model.sensors.pyramid.optics import PyramidOptics
from service.model.sensors.pyramid.signals import differentiate_signals, reference_slopes
from service.model.sensors.registry import kind_of
from sim_rtc.computer.feed import BATCH_FRAMES, PhaseFeed
from sim_rtc.computer.loop import LoopTerms, ModalLoop
from sim_rtc.telescope.atmosphere import Layer, build_layers
from sim_rtc.telescope.detector import PixelDetector
from sim_rtc.telescope.diffractive import (
    DiffractivePlant,
    DiffractivePyramid,
    Quadrature,
    build_centred_pupil,
)
from sim_rtc.telescope.imperfections import Imperfections
from sim_rtc.telescope.mirror import MirrorFaults
from sim_rtc.telescope.registration import Drift, Jump, MovingOptics, Schedule
from sim_rtc.telescope.scene import Scene, SceneKind
from sim_rtc.telescope.sky import SeeingSchedule, Sky, Turbulence, Vibrations


class Immediate(Executor):
    """Does the work when it is submitted: what the background would have had time for."""

    def submit(self, function, /, *args, **kwargs):
        future = Future()
        future.set_result(function(*args, **kwargs))
        return future


TURNED = Misregistration(
    shift_x_subap=0.2, shift_y_subap=-0.1, rotation_rad=0.01, magnification=1.004
)
PERFECT = Imperfections(unevenness=0.0, position_error=0.0)


@pytest.fixture(scope="module")
def pupil(small_instrument):
    return build_centred_pupil(small_instrument, 3)


@pytest.fixture(scope="module")
def plant(small_instrument, small_basis):
    return DiffractivePlant(small_instrument, small_basis, rng=np.random.default_rng(1))


def phases(pupil, rms_m, seed=1, n=1, finest=8):
    """Random waves of this RMS, ``(n, n_points)``, up to ``finest`` radians per pupil radius."""
    rng = np.random.default_rng(seed)
    u = pupil.points / np.abs(pupil.points).max()
    maps = sum(
        np.outer(
            rng.standard_normal(n), np.cos(u @ rng.uniform(-finest, finest, 2) + rng.uniform(0, 6))
        )
        for _ in range(12)
    )
    maps -= (maps @ pupil.weights)[:, None]
    return maps * rms_m / np.sqrt(maps**2 @ pupil.weights)[:, None]


def test_the_pupil_has_a_point_at_its_centre_and_the_area_of_the_annulus(small_instrument, pupil):
    assert 0.0 in pupil.coordinates
    area = np.pi / 4 * 10.0**2 * (1 - small_instrument.obscuration_ratio**2)
    assert pupil.amplitude.sum() / 9 == pytest.approx(area, rel=1e-3)


def test_a_flat_wavefront_shows_the_images_of_the_services_optics(small_instrument, pupil):
    shift = (0.23, -0.31)
    sensor = DiffractivePyramid(
        small_instrument.wfs, pupil, shift, Quadrature(n_modulation=28, dtype=np.complex128)
    )
    expected = PyramidOptics(
        wfs=small_instrument.wfs, pupil=pupil, n_nodes=2, n_modulation=28, dtype=np.float64
    ).images(shift)
    found = sensor.images(np.zeros(len(pupil.points)))
    np.testing.assert_allclose(found, expected, atol=1e-12 * expected.max())


@pytest.mark.parametrize("precision", [np.complex64, np.complex128])
def test_small_phases_give_the_slopes_of_the_linear_jacobian(small_instrument, pupil, precision):
    """1 nm RMS: what is even in the phase is 0.1 % of the slopes and cancels in push-pull."""
    wfs, shift = small_instrument.wfs, (0.1, 0.2)
    linear = PyramidOptics(wfs=wfs, pupil=pupil, n_nodes=2, n_modulation=28)
    valid = valid_subapertures(small_instrument)
    jacobian = differentiate_signals(linear.response(valid, shift), valid)
    sensor = DiffractivePyramid(wfs, pupil, shift, Quadrature(n_modulation=28, dtype=precision))
    for opd_m in phases(pupil, 1e-9, n=5):
        push, pull = (reference_slopes(sensor.images(s * opd_m), valid)[0] for s in (1, -1))
        expected = jacobian @ opd_m * 2 * np.pi / wfs.wavelength_m
        assert np.linalg.norm((push - pull) / 2 - expected) < 1e-3 * np.linalg.norm(expected)


def test_large_residuals_lower_the_response_to_a_small_mode(small_instrument, pupil):
    """The optical gain, that no linear plant has; waves beyond the modulation bring it about."""
    sensor = DiffractivePyramid(small_instrument.wfs, pupil)
    valid = np.ones((10, 10), dtype=bool)
    probe = phases(pupil, 5e-9, seed=7)[0]

    def response(residual):
        push, pull = (
            reference_slopes(sensor.images(residual + s * probe), valid)[0] for s in (1, -1)
        )
        return push - pull

    flat = response(np.zeros_like(probe))
    residuals = phases(pupil, 120e-9, seed=8, n=10, finest=40)
    gains = [response(residual) @ flat / (flat @ flat) for residual in residuals]
    assert 0.2 < np.mean(gains) < 0.8


def test_light_is_neither_made_nor_lost_by_the_phase_alone(small_instrument, pupil):
    """What leaves the images goes elsewhere on the detector: less is left, never more."""
    sensor = DiffractivePyramid(small_instrument.wfs, pupil)
    flat = sensor.images(np.zeros(len(pupil.points))).sum()
    rough = sensor.images(phases(pupil, 200e-9)[0]).sum()
    assert rough <= flat
    assert flat < (pupil.amplitude**2).sum() / 9


def test_a_shift_by_a_whole_subaperture_moves_the_images_by_one_pixel(small_instrument, pupil):
    sensor = DiffractivePyramid(small_instrument.wfs, pupil)
    opd_m = phases(pupil, 60e-9)[0]
    at_rest, moved = sensor.images(opd_m), sensor.at((1.0, 0.0)).images(opd_m)
    np.testing.assert_allclose(moved[..., 1:], at_rest[..., :-1], atol=1e-5 * at_rest.max())


def test_modulation_points_that_do_not_pair_up_are_refused():
    with pytest.raises(ModelError, match="found 25 modulation points; expected an even number"):
        Quadrature(n_modulation=25)


def test_a_larger_modulation_gets_more_points(small_instrument, small_basis):
    """The same wavefront on 24 points and on as many as the plant takes at 10 % more radius."""
    wide = DiffractivePlant(
        small_instrument,
        small_basis,
        rng=np.random.default_rng(1),
        imperfections=replace(PERFECT, modulation_error=0.10),
    )
    converged = DiffractivePlant(
        small_instrument,
        small_basis,
        rng=np.random.default_rng(1),
        imperfections=replace(PERFECT, modulation_error=0.10),
        quadrature=Quadrature(n_modulation=48),
    )
    tilt = 5e-9 * small_basis.render(wide.points_m / small_instrument.subaperture_m)[:, 0]
    rng = np.random.default_rng(2)
    found, expected = (
        plant.optics(Misregistration()).slopes(tilt.astype(np.float32), None, rng)
        for plant in (wide, converged)
    )
    assert np.linalg.norm(found - expected) < 2e-3 * np.linalg.norm(expected)


def test_a_flat_wavefront_has_no_slopes(plant):
    optics = plant.optics(TURNED)
    flat = np.zeros(len(plant.weights), dtype=np.float32)
    slopes = optics.slopes(flat, None, np.random.default_rng(1))
    np.testing.assert_array_equal(slopes, 0.0)


def test_photons_scatter_the_slopes_as_counting_them_says(plant):
    optics = plant.optics(TURNED)
    flat = np.zeros(len(plant.weights), dtype=np.float32)
    detector, rng = PixelDetector(electrons_per_light=1e5), np.random.default_rng(2)
    draws = np.array([optics.slopes(flat, detector, rng) for _ in range(2000)])
    own = optics.images.sum(axis=(0, 2))[plant.valid] * 1e5
    expected = np.sqrt(np.tile(own + 4 * 4.0**2, 2)) / own.mean()
    # 2000 draws: 1.6 % on a σ, 320 of them.
    np.testing.assert_allclose(draws.std(axis=0), expected, rtol=0.08)


def test_the_mirror_is_another_than_the_services(plant, small_basis):
    optics = plant.optics(Misregistration())
    subap = plant.points_m / plant.pitch_m / 3
    nominal = small_basis.render(subap)
    weights = plant.weights[:, None]
    difference = np.sqrt((weights * (optics.opd_per_command - nominal) ** 2).sum(axis=0))
    assert 0.005 < np.median(difference) < 0.2


@pytest.mark.parametrize("moved", [[], [0, 1, 2], [0, 1, 2, 30, 39], [5], list(range(3, 40))])
def test_the_mirror_adds_the_modes_that_are_commanded_and_no_others(plant, moved):
    optics = plant.optics(TURNED)
    command = np.zeros(40, dtype=np.float32)
    command[moved] = np.random.default_rng(3).normal(0.0, 1e-7, len(moved))
    expected = optics.opd_per_command.astype(float) @ command
    np.testing.assert_allclose(optics.mirror_opd_m(command), expected, atol=1e-12)


def test_a_turned_mirror_is_seen_turned(small_instrument, small_basis):
    plant = DiffractivePlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=PERFECT
    )
    angle = np.deg2rad(90.0)
    tilt = plant.optics(Misregistration(rotation_rad=angle)).opd_per_command[:, 0]
    x, y = plant.points_m.T
    # The mirror's tilt along its x now rises along the sensor's y.
    assert tilt @ y > 100 * abs(tilt @ x)


def test_the_telescope_as_stop_moves_the_modes_instead_of_the_images(small_instrument, small_basis):
    instrument = replace(small_instrument, stop=Stop.TELESCOPE)
    plant = DiffractivePlant(
        instrument, small_basis, rng=np.random.default_rng(1), imperfections=PERFECT
    )
    moved, aligned = (plant.optics(alpha) for alpha in (TURNED, Misregistration()))
    np.testing.assert_array_equal(moved.images, aligned.images)
    assert np.abs(moved.opd_per_command - aligned.opd_per_command).max() > 0.01


def test_by_day_the_mirror_is_seen_twice(small_instrument, small_basis):
    once, twice = (
        DiffractivePlant(
            small_instrument, small_basis, rng=np.random.default_rng(1), scene=Scene(kind=kind)
        ).optics(TURNED)
        for kind in (SceneKind.ONSKY, SceneKind.DAYTIME)
    )
    np.testing.assert_allclose(twice.opd_per_command, 2 * once.opd_per_command, rtol=1e-6)


def test_a_drift_moves_the_images_exactly(plant):
    near = replace(TURNED, shift_x_subap=TURNED.shift_x_subap + 0.04)
    blend = plant.optics(TURNED).towards(plant.optics(near), 0.5)
    exact = plant.optics(replace(TURNED, shift_x_subap=TURNED.shift_x_subap + 0.02))
    np.testing.assert_allclose(blend.alpha.vector, exact.alpha.vector)
    np.testing.assert_allclose(blend.images, exact.images, atol=1e-6 * exact.images.max())
    np.testing.assert_allclose(blend.opd_per_command, exact.opd_per_command, atol=1e-6)


def test_a_binned_sensor_keeps_its_pupil_points(small_instrument, small_basis):
    coarse = replace(
        small_instrument, wfs=kind_of(small_instrument).bin_sensor(small_instrument.wfs, 2)
    )
    plant = DiffractivePlant(
        coarse, small_basis, rng=np.random.default_rng(1), binning=2, imperfections=PERFECT
    )
    optics = plant.optics(Misregistration())
    assert optics.images.shape == (2, 5, 2, 5)
    assert len(plant.points_m) == pytest.approx(np.pi / 4 * 30**2, rel=0.1)


def feed(plant, schedule):
    optics = MovingOptics(plant, schedule, Immediate())
    layers = build_layers(
        (Layer(fraction=1.0, speed_m_s=15.0, direction_deg=20.0),),
        points_m=plant.points_m,
        pitch_m=plant.pitch_m,
        turbulence=KarhunenLoeve(r0_m=0.25),
        rng=np.random.default_rng(2),
    )
    return PhaseFeed(
        sky=Sky(
            turbulence=Turbulence(layers, SeeingSchedule(start_arcsec=1.0)),
            vibrations=Vibrations(
                (),
                points=plant.points_m,
                weights=plant.weights,
                frame_rate_hz=500.0,
                rng=np.random.default_rng(4),
            ),
        ),
        optics=optics,
        detector=PixelDetector(electrons_per_light=1e6),
        frame_rate_hz=500.0,
        jump_times_s=tuple(jump.time_s for jump in schedule.jumps),
        rng=np.random.default_rng(3),
    )


def test_the_slopes_on_the_wire_are_those_of_the_command_beside_them(plant, small_instrument):
    block = next(feed(plant, Schedule(start=TURNED)).blocks())
    optics = block.optics
    terms = LoopTerms.of(
        optics, np.zeros((40, optics.n_slopes), np.float32), np.zeros(40, np.float32), leak=1.0
    )
    dither = np.random.default_rng(4).normal(0.0, 2e-8, (BATCH_FRAMES, 40)).astype(np.float32)
    loop = ModalLoop(n_modes=40, delay_frames=2, stroke_m=1e-5)
    result = block.run(20, loop, terms, dither)
    np.testing.assert_array_equal(result.commands_m, dither)
    quiet = [
        optics.slopes(
            block.phase_at(20 + k) + optics.opd_per_command @ dither[k],
            None,
            np.random.default_rng(5),
        )
        for k in range(BATCH_FRAMES)
    ]
    noise = result.slopes - quiet
    # 320 slopes of 1e6 / 80 electrons: 1 %.
    assert noise.std() < 0.02
    assert np.std(quiet) > 5 * noise.std()


def test_phases_are_continuous_from_block_to_block(plant, small_instrument):
    blocks = islice(feed(plant, Schedule(start=TURNED)).blocks(), 3)
    seen = np.concatenate([block.phases_m for block in blocks])
    steps = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    assert steps[[199, 399]].max() < 2 * np.median(steps)


def test_jumps_and_drifts_change_the_optics(plant, small_instrument):
    schedule = Schedule(
        start=Misregistration(),
        drift=Drift(shift_x_subap=0.3),
        jumps=(Jump(time_s=0.25, shift_y_subap=0.2),),
    )
    blocks = list(islice(feed(plant, schedule).blocks(), 2))
    assert [b.first_frame for b in blocks] == [0, 130]
    assert blocks[1].optics.alpha.shift_y_subap == pytest.approx(0.2)


def test_a_stuck_actuator_is_in_every_phase(small_instrument, small_basis):
    faults = MirrorFaults(stuck=((20, 3e-7),))
    healthy, stuck = (
        DiffractivePlant(small_instrument, small_basis, rng=np.random.default_rng(1), faults=faults)
        for faults in (MirrorFaults(), faults)
    )
    schedule = Schedule(start=Misregistration())
    clean, bumped = (next(feed(plant, schedule).blocks()) for plant in (healthy, stuck))
    bump = bumped.phases_m - clean.phases_m
    # The peak falls between the pupil's points; beside it the plate swings back a little.
    assert 0.6 * 3e-7 < bump[7].max() <= 3e-7
    assert bump[7].min() > -0.2 * 3e-7


def test_the_loop_closes_on_it(plant, small_instrument, small_basis):
    """With the inverse of its small-signal matrix little is left but what no mode can correct."""
    blocks = feed(plant, Schedule(start=TURNED)).blocks()
    block = next(blocks)
    optics, rng = block.optics, np.random.default_rng(6)
    poke = 2e-9
    matrix = np.column_stack(
        [
            optics.slopes(poke * mode, None, rng) - optics.slopes(-poke * mode, None, rng)
            for mode in optics.opd_per_command.T
        ]
    ) / (2 * poke)
    inverse = np.linalg.pinv(matrix).astype(np.float32)
    terms = LoopTerms.of(optics, inverse, np.full(40, 0.5, np.float32), leak=1.0)
    loop = ModalLoop(n_modes=40, delay_frames=2, stroke_m=1e-5)
    modes, weights = optics.opd_per_command.astype(float), plant.weights
    weighted = modes * weights[:, None]
    left, fitting = [], []
    for row in range(0, block.n_frames, BATCH_FRAMES):
        result = block.run(row, loop, terms, None)
        phase = block.phase_at(row) - weights @ block.phase_at(row)
        content = np.linalg.solve(modes.T @ weighted, weighted.T @ phase)
        for kept, residual in (
            (left, phase + modes @ result.commands_m[0]),
            (fitting, phase - modes @ content),
        ):
            kept.append(np.sqrt(weights @ (residual - weights @ residual) ** 2))
    assert np.mean(left[10:]) < 1.35 * np.mean(fitting[10:])
    assert left[0] > 3 * np.mean(fitting)


def test_images_displaced_alike_are_images_shifted(pupil, small_instrument):
    wfs, (opd_m,) = small_instrument.wfs, phases(pupil, 100e-9)
    offset = (0.12, -0.07)
    apart = DiffractivePyramid(wfs, pupil, offsets_subap=np.tile(offset, (2, 2, 1)))
    together = DiffractivePyramid(wfs, pupil, offset)
    light = together.images(opd_m)
    np.testing.assert_allclose(apart.images(opd_m), light, rtol=0, atol=2e-5 * light.max())


def test_one_image_alone_is_displaced_along_its_own_axes(pupil, small_instrument):
    """Side along y 0, side along x 1: the image at +x -y moves by its (x, y), the others stay."""
    wfs, (opd_m,) = small_instrument.wfs, phases(pupil, 100e-9)
    offsets = np.zeros((2, 2, 2))
    offsets[0, 1] = (0.3, 0.1)
    light = DiffractivePyramid(wfs, pupil, offsets_subap=offsets).images(opd_m)
    at_rest = DiffractivePyramid(wfs, pupil).images(opd_m)
    moved = DiffractivePyramid(wfs, pupil, (0.3, 0.1)).images(opd_m)
    expected = at_rest.copy()
    expected[0, :, 1] = moved[0, :, 1]
    np.testing.assert_allclose(light, expected, rtol=0, atol=2e-5 * light.max())


def test_displacements_of_the_images_reach_the_light(small_instrument, small_basis):
    given = (0.1, 0.0, -0.1, 0.2, 0.0, -0.1, 0.0, -0.1)  # their mean is 0
    changes = replace(PERFECT, image_offsets_px=given)
    made = DiffractivePlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=changes
    )
    ideal = DiffractivePlant(
        small_instrument, small_basis, rng=np.random.default_rng(1), imperfections=PERFECT
    )
    np.testing.assert_allclose(made.image_offsets_px, np.reshape(given, (4, 2)))
    assert ideal.image_offsets_px is None
    images, places = made.optics(TURNED).images, ideal.optics(TURNED).images
    wider = replace(
        small_instrument, wfs=kind_of(small_instrument).bin_sensor(small_instrument.wfs, 2)
    )
    coarse = DiffractivePlant(
        wider, small_basis, binning=2, rng=np.random.default_rng(1), imperfections=changes
    )
    n = np.arange(images.shape[1])
    for (y, x), (to_x, to_y) in zip(np.ndindex(2, 2), made.image_offsets_px, strict=True):
        for axis, offset in ((0, to_x), (1, to_y)):
            after, before = (light[y, :, x].sum(axis=axis) for light in (images, places))
            moved = after @ n / after.sum() - before @ n / before.sum()
            # the pupil fills the grid: the light that leaves it counts no more
            low, high = sorted((0.7 * offset, offset))
            assert low - 0.005 < moved < high + 0.005
    # a pixel of the finest sensor is half a subaperture of the binned one
    np.testing.assert_allclose(coarse._sensor._offsets_subap, np.reshape(given, (2, 2, 2)) / 2)


def response_nm(optics):
    """Return the slopes of a push and pull of 1 nm of each mode, per metre."""
    modes = np.ascontiguousarray(optics.opd_per_command.T)
    rng = np.random.default_rng(1)
    sides = [[optics.slopes(sign * 1e-9 * mode, None, rng) for mode in modes] for sign in (1, -1)]
    return (np.array(sides[0]) - np.array(sides[1])).T / 2e-9


def test_displaced_images_are_those_of_the_services_model(small_instrument, small_basis):
    """Given the displacements the model leaves 3 %, its other mirror; without them 20 %."""
    few = small_basis.subset(np.arange(12))
    changes = replace(PERFECT, image_offset_rms_px=0.2)
    plant = DiffractivePlant(
        small_instrument, few, rng=np.random.default_rng(1), imperfections=changes
    )
    found = response_nm(plant.optics(TURNED))

    def left(offsets_px):
        places = None if offsets_px is None else tuple(map(tuple, offsets_px))
        wfs = replace(small_instrument.wfs, image_offsets_subap=places)
        model = InteractionModel(replace(small_instrument, wfs=wfs), few, pupil_sampling=4)
        return np.linalg.norm(found - model.interaction_matrix(TURNED)) / np.linalg.norm(found)

    offsets = plant.image_offsets_px
    assert left(offsets) < 0.04
    for wrong in (None, -offsets, offsets[:, ::-1], offsets[[1, 0, 2, 3]]):
        assert left(wrong) > 2.5 * left(offsets)
    told = replace(
        small_instrument,
        wfs=replace(small_instrument.wfs, image_offsets_subap=tuple(map(tuple, offsets))),
    )
    as_told = DiffractivePlant(told, few, rng=np.random.default_rng(1), imperfections=PERFECT)
    np.testing.assert_allclose(
        as_told.optics(TURNED).images, plant.optics(TURNED).images, rtol=0, atol=1e-9
    )
