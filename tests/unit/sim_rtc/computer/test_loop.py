import numpy as np
import pytest

from sim_rtc.computer.loop import LoopTerms, ModalLoop

N_MODES = 4
STROKE_M = 10e-6


def terms(gain, leak=1.0, n_controlled=3):
    """A sensor with twice as many slopes as modes, inverted exactly."""
    rng = np.random.default_rng(1)
    response = rng.standard_normal((2 * N_MODES, N_MODES)).astype(np.float32)
    inverse = np.linalg.pinv(response[:, :n_controlled]).astype(np.float32)
    return LoopTerms(
        reconstructor=inverse,
        slopes_per_command=response,
        modal_response=inverse @ response,
        gains=np.full(n_controlled, gain, dtype=np.float32),
        leak=leak,
    )


def run(loop, wavefront_m, chosen, dither_m=None, n_block=10):
    """Run ``wavefront_m`` ``(n_frames, N_MODES)`` through the loop, block by block."""
    blocks = []
    for start in range(0, len(wavefront_m), n_block):
        piece = wavefront_m[start : start + n_block].astype(np.float32)
        dither = None if dither_m is None else dither_m[start : start + n_block]
        blocks.append(loop.run(piece @ chosen.slopes_per_command.T, chosen, dither))
    return (
        np.concatenate([b.slopes for b in blocks]),
        np.concatenate([b.commands_m for b in blocks]),
        sum(b.n_clipped for b in blocks),
    )


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("leak", [1.0, 0.98])
@pytest.mark.parametrize("period", [400, 40, 12])
def test_rejection_is_that_of_a_delayed_leaky_integrator(delay, leak, period):
    gain, n_frames = 0.25, 10 * period + 1000  # in which all has settled
    loop = ModalLoop(n_modes=N_MODES, delay_frames=delay, stroke_m=STROKE_M)
    phasor = np.exp(2j * np.pi * np.arange(n_frames) / period)
    wavefront = np.zeros((n_frames, N_MODES))
    wavefront[:, 1] = 1e-7 * phasor.real
    _, commands, _ = run(loop, wavefront, terms(gain, leak))
    settled = slice(n_frames - 10 * period, n_frames)
    residual = wavefront[settled, 1] + commands[settled, 1]
    measured = 2 * np.mean(residual * phasor[settled].conj()) / 1e-7
    z = np.exp(2j * np.pi / period)
    expected = 1 / (1 + gain * z**-delay / (1 - leak / z))
    # float32 commands.
    assert abs(measured - expected) < 1e-4


@pytest.mark.parametrize(("gain", "stable"), [(0.97, True), (1.03, False)])
def test_two_frames_of_delay_hold_up_to_a_gain_of_one(gain, stable):
    """The poles of z² - z + g reach the unit circle at g = 1."""
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    wavefront = np.zeros((3000, N_MODES))
    wavefront[:5] = 1e-8
    _, commands, n_clipped = run(loop, wavefront, terms(gain))
    assert np.all(np.isfinite(commands))
    assert np.abs(commands).max() <= np.float32(STROKE_M)
    assert (n_clipped == 0) is stable
    assert bool(np.abs(commands[-100:]).max() < 1e-9) is stable


def test_a_clipped_loop_recovers():
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    wavefront = np.zeros((400, N_MODES))
    wavefront[:200, 0] = 50e-6
    _, commands, n_clipped = run(loop, wavefront, terms(0.4))
    assert n_clipped > 100
    assert commands[199, 0] == pytest.approx(-STROKE_M)
    assert abs(commands[399, 0]) < 1e-9


def test_commands_as_asked_go_beyond_the_stroke_and_the_slopes_do_not():
    """The loop is the same; only what is reported differs."""
    chosen, wavefront = terms(0.4), np.zeros((300, N_MODES))
    wavefront[:, 0] = 50e-6
    loops = [
        ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M, reports_asked=asked)
        for asked in (False, True)
    ]
    (slopes, played, _), (same, asked, _) = (run(loop, wavefront, chosen) for loop in loops)
    np.testing.assert_array_equal(slopes, same)
    # what it holds, less what the integrator adds in each frame: 0.4 of the 40 um that are left
    assert asked[-1, 0] == pytest.approx(-STROKE_M - 0.4 * 40e-6, rel=1e-4)
    assert played[-1, 0] == pytest.approx(-STROKE_M)
    np.testing.assert_array_equal(np.clip(asked, -STROKE_M, STROKE_M), played)


def test_the_result_does_not_depend_on_the_block_length():
    wavefront = 1e-7 * np.random.default_rng(2).standard_normal((120, N_MODES))
    results = [
        run(
            ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M),
            wavefront,
            terms(0.4),
            n_block=n_block,
        )
        for n_block in (1, 10, 120)
    ]
    for slopes, commands, _ in results[1:]:
        np.testing.assert_allclose(commands, results[0][1], atol=1e-12)
        np.testing.assert_allclose(slopes, results[0][0], atol=1e-11)


def test_rows_hold_the_slopes_of_the_command_beside_them():
    chosen = terms(0.4)
    wavefront = 1e-7 * np.random.default_rng(3).standard_normal((50, N_MODES))
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    slopes, commands, _ = run(loop, wavefront, chosen)
    np.testing.assert_allclose(
        slopes, (wavefront + commands) @ chosen.slopes_per_command.T, atol=1e-12
    )


def test_the_dither_is_applied_but_never_integrated():
    chosen = terms(0.4)
    dither = np.zeros((100, N_MODES), dtype=np.float32)
    dither[:, 3] = 5e-9 * np.sin(np.arange(100.0))
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    slopes, commands, _ = run(loop, np.zeros((100, N_MODES)), chosen, dither)
    integrator = commands - dither
    np.testing.assert_array_equal(integrator[:, 3], 0.0)
    corrections = 0.4 * slopes @ chosen.reconstructor.T
    np.testing.assert_allclose(
        integrator[2:, :3], integrator[1:-1, :3] - corrections[:-2], atol=1e-14
    )


@pytest.mark.parametrize("gain", [0.0, 0.4])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_slope_that_is_no_number_costs_its_frame_and_no_other(gain, bad):
    """At gain 0 (the loop open) as at any other: 0 times NaN is NaN."""
    chosen = terms(gain)
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    controlled = np.arange(N_MODES) < 3
    run(loop, np.tile(1e-7 * controlled, (20, 1)), chosen)
    struck = np.zeros((10, 2 * N_MODES), np.float32)
    struck[4, 1] = bad
    with np.errstate(invalid="ignore"):
        block = loop.run(struck, chosen, None)
    assert np.isfinite(block.commands_m).all()
    assert not np.isfinite(block.slopes[4]).all()
    assert np.isfinite(np.delete(block.slopes, 4, axis=0)).all()
    _, commands, _ = run(loop, np.tile(2e-7 * controlled, (200, 1)), chosen)
    np.testing.assert_allclose(commands[-1], -2e-7 * controlled * (gain > 0), atol=1e-12)


def test_in_a_loop_run_frame_by_frame_such_a_frame_corrects_nothing_either():
    chosen = terms(0.4)
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    wavefront_m = np.array([1e-7, 1e-7, 1e-7, 0.0], np.float32)

    def sense(k, command):
        slopes = chosen.slopes_per_command @ (command + wavefront_m)
        return np.full_like(slopes, np.nan) if k == 3 else slopes

    block = loop.run_frames(40, sense, chosen, None)
    assert np.isnan(block.slopes[3]).all()
    np.testing.assert_array_equal(block.commands_m[5, :3], block.commands_m[4, :3])
    np.testing.assert_allclose(block.commands_m[-1, :3], -1e-7, rtol=1e-3)


def test_reset_and_release_forget():
    loop = ModalLoop(n_modes=N_MODES, delay_frames=2, stroke_m=STROKE_M)
    run(loop, np.full((20, N_MODES), 1e-7), terms(0.4))
    loop.release(2)
    _, commands, _ = run(loop, np.zeros((1, N_MODES)), terms(0.4))
    assert commands[0, 1] != 0.0
    assert commands[0, 2] == 0.0
    loop.reset()
    _, commands, _ = run(loop, np.zeros((1, N_MODES)), terms(0.4))
    assert not commands.any()
