"""What tests of several modules share of unit.test_link."""

from __future__ import annotations

import numpy as np

from service.wire import Acknowledgement, AckState, FrameHeader, encode_frames


def send(intake, seq0, n=10, rows=None, **changes):
    values = {
        "session": "s1",
        "seq0": seq0,
        "n": n,
        "t0_ns": 10**18 + seq0 * 1_000_000,
        "dt_ns": 1_000_000,
        "n_slopes": 3,
        "n_modes": 2,
        "dither": False,
        "cm_id": None,
        "basis_id": "b",
        "config_id": "c",
    }
    header = FrameHeader(**(values | changes))
    rows = np.zeros((n, header.n_columns), np.float32) if rows is None else rows
    intake.frames(*encode_frames(header, rows), recoverable=True)


def applied(intake, session):
    acknowledgement = Acknowledgement(
        session=session,
        id="cm-1",
        sha256="0" * 64,
        state=AckState.APPLIED,
        reason="",
        frame_seq=5,
    )
    intake.acknowledgement(acknowledgement, known=True)
