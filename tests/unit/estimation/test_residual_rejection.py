"""Whether a loop holds well is seen in its own commands."""

from types import SimpleNamespace

import numpy as np

from service.estimation.frames import FrameBlock
from service.estimation.residual import Rejection

N_MODES, DT_NS, GAIN = 12, 1_000_000, 0.4


def followed(response, seconds=2.0):
    """A loop whose matrix takes the true response of every mode for 1."""
    rng = np.random.default_rng(1)
    n_frames = round(seconds * 1e9 / DT_NS)
    wave = 1e-8 * np.cumsum(rng.normal(size=(n_frames, N_MODES)), axis=0)
    commands = np.zeros((n_frames + 1, N_MODES))
    for k in range(n_frames):
        commands[k + 1] = 0.99 * commands[k] - GAIN * (response @ (wave[k] + commands[k]))
    state = Rejection()
    for k in range(0, n_frames, 20):
        block = FrameBlock(
            session="s",
            first_seq=k,
            t0_ns_utc=k * DT_NS,
            dt_ns=DT_NS,
            slopes=np.zeros((20, 4), np.float32),
            commands_m=np.float32(commands[k : k + 20]),
            dither_m=None,
            cm_id="a",
        )
        rtc = SimpleNamespace(gains=np.full(N_MODES, GAIN), leak=0.99)
        loop = SimpleNamespace(in_loop=np.arange(N_MODES))
        state = state.update(SimpleNamespace(block=block, rtc=rtc, loop=loop))
    return state


def test_a_loop_that_follows_holds_well():
    assert followed(np.eye(N_MODES)).holds is True


def test_one_whose_modes_are_turned_into_each_other_does_not():
    cos, sin = np.cos(1.4), np.sin(1.4)
    turned = np.kron(np.eye(N_MODES // 2), [[cos, -sin], [sin, cos]])
    assert followed(turned).holds is False


def test_a_second_is_needed_to_tell():
    assert followed(np.eye(N_MODES), 0.5).holds is None
    assert Rejection().holds is None
