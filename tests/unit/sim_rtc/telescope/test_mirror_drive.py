import numpy as np

from sim_rtc.telescope.mirror import MirrorDrive, MirrorLimits

RATE_HZ = 1000.0


def drive(instrument, basis, **options):
    return MirrorDrive(instrument.mirror, basis.mode_to_actuator, frame_rate_hz=RATE_HZ, **options)


def test_an_ideal_mirror_does_as_it_is_told(small_instrument, small_basis):
    command = np.random.default_rng(3).normal(0.0, 1e-8, 40).astype(np.float32)
    followed = command.copy()
    assert drive(small_instrument, small_basis).follow(followed, None) == 0
    np.testing.assert_array_equal(followed, command)


def test_the_mean_over_the_exposure_is_that_of_an_exponential(small_instrument, small_basis):
    rise_s = 0.7e-3
    slow = drive(small_instrument, small_basis, rise_s=rise_s)
    time_constant = rise_s * RATE_HZ / np.log(9.0)
    seen = []
    for _ in range(6):
        command = np.zeros(40, dtype=np.float32)
        command[3] = 1e-7
        slow.follow(command, None)
        seen.append(command[3] / 1e-7)
    t = np.arange(6)
    mean_left = time_constant * (1 - np.exp(-1 / time_constant)) * np.exp(-t / time_constant)
    np.testing.assert_allclose(seen, 1.0 - mean_left, rtol=1e-5)


def test_the_dither_part_lags_as_the_whole_does(small_instrument, small_basis):
    slow = drive(small_instrument, small_basis, rise_s=2e-3)
    rng = np.random.default_rng(4)
    for _ in range(5):
        dither = rng.normal(0.0, 1e-8, 40).astype(np.float32)
        whole = dither.copy()
        slow.follow(whole, dither)
        np.testing.assert_allclose(whole, dither, rtol=1e-5, atol=1e-14)
    # After its end it dies away with the rest.
    whole = np.zeros(40, dtype=np.float32)
    slow.follow(whole, None)
    assert np.abs(whole).max() > 0.0


def test_a_sharp_bend_is_flattened_and_counted(small_instrument, small_basis):
    limits = MirrorLimits(bend_m=0.2e-6)
    strokes = small_basis.mode_to_actuator
    limited = drive(small_instrument, small_basis, limits=limits)
    command = np.zeros(40, dtype=np.float32)
    command[39] = 2e-6
    asked = command.copy()
    assert limited.follow(command, None) > 0
    assert np.abs(strokes @ command).max() < np.abs(strokes @ asked).max()
    # A tilt of the same size bends only the edge, where a neighbour is missing.
    tilt = np.zeros(40, dtype=np.float32)
    tilt[0] = 0.2e-6
    assert drive(small_instrument, small_basis, limits=limits).follow(tilt, None) == 0


def test_no_actuator_is_asked_for_much_more_than_its_stroke(small_instrument, small_basis):
    limits = MirrorLimits(stroke_m=1e-6, bend_m=1.0)
    limited = drive(small_instrument, small_basis, limits=limits)
    command = np.zeros(40, dtype=np.float32)
    command[0] = 3e-6
    assert limited.follow(command, None) > 0
    # The modes cannot make the clipped shape exactly.
    assert np.abs(small_basis.mode_to_actuator @ command).max() < 1.5e-6
