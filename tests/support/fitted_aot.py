"""What tests of several modules share of unit.fitting.test_aot."""

from __future__ import annotations

import numpy as np

from service.model.pupil import rtc_valid_subapertures
from service.wire import FrameHeader, Loop, Manifest, MatrixLayout, Status, checksum
from tests.support.archive_nights import NOON
from tests.support.small import small_instrument

N_MODES, N_FRAMES = 6, 200


INSTRUMENT = small_instrument()


N_SLOPES = 2 * int(rtc_valid_subapertures(INSTRUMENT).sum())


RNG = np.random.default_rng(5)


ROWS = RNG.normal(size=(N_FRAMES, N_SLOPES + N_MODES)).astype(np.float32)


MATRIX = RNG.normal(size=(4, N_SLOPES)).astype(np.float32)


def header(k, n=20, **changes):
    return FrameHeader(
        **{
            "session": "s-1",
            "seq0": 1000 + k,
            "n": n,
            "t0_ns": NOON + k * 1_000_000,
            "dt_ns": 1_000_000,
            "n_slopes": N_SLOPES,
            "n_modes": N_MODES,
            "dither": False,
            "cm_id": "cm-1" if k < 100 else "cm-2",
            "basis_id": "kl",
            "config_id": "b1",
        }
        | changes
    )


STATUS = Status(
    session="s-1",
    seq=999,
    t_ns=NOON,
    loop=Loop.CLOSED,
    frame_rate_hz=1000.0,
    delay_frames=2.0,
    gains=(0.4,) * N_MODES,
    leak=1.0,
    n_slopes=N_SLOPES,
    n_modes=N_MODES,
    n_controlled=4,
    cm_id="cm-1",
    basis_id="kl",
    config_id="b1",
    dither=None,
    max_dither_m=1e-7,
    max_dither_modes=4,
    magnitude=None,
)


MANIFEST = Manifest(
    id="cm-1",
    layout=MatrixLayout(shape=(4, N_SLOPES), sha256=checksum(MATRIX), n_chunks=1, chunk_bytes=4096),
    alpha=None,
    sigma=None,
    im_id=None,
    parent=None,
    basis_id="kl",
    config_id="b1",
    system="small",
    created_ns=1,
)
