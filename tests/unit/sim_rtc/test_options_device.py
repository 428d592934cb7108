import numpy as np
import pytest

from service.errors import ConfigurationError
from service.model.surface import mirror_surface
from sim_rtc.assembly import build_drive, build_plant
from sim_rtc.options import parse_options
from sim_rtc.telescope.detector import bin_pixels
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.mirror import MirrorFaults


def refusal(capsys, *given):
    with pytest.raises(SystemExit) as ended:
        parse_options(list(given))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_by_default_mirror_and_detector_are_as_before():
    devices = parse_options([])
    assert not devices.needs_drive
    assert devices.mirror_faults == MirrorFaults()
    assert (devices.camera.read_noise_electrons, devices.camera.excess_noise) == (4.0, 1.0)


def test_faults_limits_and_noise_are_read_in_the_units_they_are_given_in():
    mirror = "--rise-ms 0.7 --actuator-stroke 20 --actuator-bend 2"
    faults = "--dead-actuators 12,40 --stuck-actuators 7:-1e-6 --excess-noise 2"
    devices = parse_options(f"{mirror} {faults}".split())
    assert devices.rise_ms == pytest.approx(0.7)
    assert devices.mirror_limits.stroke_m == pytest.approx(20e-6)
    assert devices.mirror_limits.bend_m == pytest.approx(2e-6)
    assert devices.mirror_faults == MirrorFaults(dead=(12, 40), stuck=((7, -1e-6),))
    assert devices.camera.excess_noise == 2.0
    assert devices.needs_drive


def test_the_diffractive_plant_takes_its_time_unless_told_otherwise():
    assert parse_options([]).speed == 1.0
    assert parse_options(["--plant", "diffractive"]).speed == 0.0
    assert parse_options(["--plant", "diffractive", "--speed", "0.1"]).speed == 0.1


def test_a_preset_follows_the_magnitude():
    options = parse_options(["--preset", "flao", "--mag", "12", "--plant", "diffractive"])
    assert (options.frame_rate_hz, options.n_controlled(594)) == (800.0, 153)
    assert options.binning == 2


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (["--dead-actuators", "1,x"], "found '1,x'; expected whole numbers from 0, like 12,40"),
        (["--stuck-actuators", "5"], "found '5'; expected N:METRES"),
        (["--stuck-actuators", "5:1"], "at most 1e-4 m"),
        (["--image-offsets", "0,0,0,0"], "expected X1,Y1"),
        (["--image-offsets", "0,0,0,0,0,0,0,0", "--image-offset-rms", "0.1"], "one of them"),
        (["--excess-noise", "0.5"], "expected a number from 1 to 4"),
        (["--rise-ms", "-1"], "expected a number from 0 to 100"),
        (["--preset", "flao", "--mag", "19"], "expected a star of 16.5 or brighter"),
    ],
)
def test_devices_that_cannot_be_are_refused_in_one_line(capsys, given, text):
    assert text in refusal(capsys, *given)


def test_an_ideal_linear_mirror_needs_no_drive(small_instrument, small_basis):
    assert build_drive(parse_options([]), small_instrument, small_basis) is None
    for given in (["--rise-ms", "0.7"], ["--plant", "diffractive"]):
        assert build_drive(parse_options(given), small_instrument, small_basis) is not None


def test_the_plant_is_the_one_asked_for(small_instrument, small_basis):
    options = parse_options(["--plant", "diffractive"])
    plant = build_plant(options, small_instrument, small_basis, np.random.default_rng(1))
    assert isinstance(plant, DiffractivePlant)


def test_a_linear_plant_refuses_pixels_it_cannot_bin(small_instrument, small_basis):
    options = parse_options(["--preset", "flao", "--mag", "12"])
    with pytest.raises(ConfigurationError, match="needs --plant diffractive; found --plant linear"):
        build_plant(options, small_instrument, small_basis, np.random.default_rng(1))


@pytest.mark.parametrize("plant", ["linear", "diffractive"])
def test_actuators_the_mirror_does_not_have_are_refused(small_instrument, small_basis, plant):
    options = parse_options(["--plant", plant, "--dead-actuators", "3,500"])
    with pytest.raises(ConfigurationError, match="found actuator 500"):
        build_plant(options, small_instrument, small_basis, np.random.default_rng(1))


def test_binning_leaves_the_modes_as_they_are(small_instrument, small_basis):
    coarse = bin_pixels(small_instrument, 2)
    surface = mirror_surface(coarse.analytic_mirror, coarse.subaperture_m)
    basis = small_basis.of_surface(surface)
    metres = np.random.default_rng(2).uniform(-3.0, 3.0, (40, 2))
    np.testing.assert_allclose(
        basis.render(metres / coarse.subaperture_m),
        small_basis.render(metres / small_instrument.subaperture_m),
        atol=1e-9,
    )


def test_limits_alone_put_a_linear_mirror_on_a_drive():
    assert parse_options(["--actuator-bend", "1"]).needs_drive
