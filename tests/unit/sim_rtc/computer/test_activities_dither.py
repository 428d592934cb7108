import numpy as np
import pytest

from pyrcal.rtc.dither import Dither, check_dither
from service.wire import DitherKind, DitherRequest


def request(**changes):
    values = {
        "id": "d",
        "kind": DitherKind.SINE,
        "modes": (3, 1),
        "amplitude_m": (5e-9, 2e-9),
        "frequency_hz": (40.0, 55.0),
        "duration_s": 0.5,
    } | changes
    return DitherRequest(**values)


def play(chosen, n_frames, n_block=10):
    dither = Dither(chosen, start_seq=20, n_modes=5, frame_rate_hz=500.0)
    return [dither.commands(seq, n_block) for seq in range(0, n_frames, n_block)]


def test_a_sine_has_the_rms_and_the_phase_it_was_asked_for():
    blocks = play(request(), 400)
    assert blocks[0] is None
    assert blocks[1] is None
    assert blocks[-1] is None
    played = np.concatenate([b for b in blocks if b is not None])
    assert played.shape == (250, 5)
    frame = np.arange(250)
    expected = 5e-9 * np.sqrt(2) * np.sin(2 * np.pi * 40.0 * frame / 500.0)
    np.testing.assert_allclose(played[:, 3], expected, atol=1e-15)
    assert played[:, 1].std() == pytest.approx(2e-9, rel=0.01)
    assert not played[:, [0, 2, 4]].any()


def test_a_binary_sequence_repeats_with_its_seed_whatever_the_blocks():
    def binary(seed, n_block):
        blocks = play(request(kind=DitherKind.BINARY, frequency_hz=None, seed=seed), 300, n_block)
        return np.concatenate([b for b in blocks if b is not None])[:250]

    first = binary(1, 10)
    np.testing.assert_array_equal(np.abs(first[:, 3]), np.float32(5e-9))
    np.testing.assert_array_equal(first, binary(1, 20))
    assert not np.array_equal(first, binary(2, 10))
    # 250 signs: 4 standard errors.
    assert abs(np.sign(first[:, 3]).mean()) < 4 / np.sqrt(250)


def test_it_ends_within_a_batch():
    dither = Dither(request(duration_s=0.03), start_seq=20, n_modes=5, frame_rate_hz=500.0)
    assert dither.stop_seq == 35
    last = dither.commands(30, 10)
    assert last[:5].any()
    assert not last[5:].any()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, ""),
        ({"modes": (3, 5)}, "range: mode 5, expected 0 to 4"),
        ({"amplitude_m": (5e-9, 1e-6)}, "range: amplitude_m 1e-06, expected at most 5e-08"),
        ({"frequency_hz": (40.0, 250.0)}, "range: frequency_hz 250, expected below 250"),
        ({"duration_s": 4000.0}, "range: duration_s 4000, expected at most 3600"),
    ],
)
def test_what_cannot_be_played_is_refused(changes, reason):
    limits = {"max_amplitude_m": 50e-9, "max_duration_s": 3600.0}
    found = check_dither(request(**changes), n_modes=5, frame_rate_hz=500.0, **limits)
    assert found == reason
