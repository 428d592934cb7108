"""What tests of several modules share of unit.playback.test_pyrtc."""

from __future__ import annotations

import json

import numpy as np

N_SLOPES, N_MODES = 224, 6


def session_in(folder, *, signals, commands, facts=None, **changes):
    """Write what ``Telemetry.save`` of pyRTC 2.1 does; frames are by their ids."""
    folder.mkdir()
    streams = []
    for name, frames in (("bench-signal", signals), ("bench-wfc", commands)):
        (folder / name).mkdir()
        values = np.array(list(frames.values()), np.float32)
        np.save(folder / name / "frames.npy", values)
        np.save(folder / name / "frame_ids.npy", np.array(list(frames), np.uint64))
        np.save(folder / name / "timestamps.npy", 1.7e9 + 0.002 * np.array(list(frames)))
        kinds = ("frames", "frame_ids", "timestamps")
        files = {f"{one}_file": f"{name}/{one}.npy" for one in kinds}
        streams.append({"name": name, "shape": list(values.shape[1:]), **files} | changes)
    (folder / "session.json").write_text(json.dumps({"schema_version": 1, "streams": streams}))
    if facts is not None:
        np.savez(folder / "loop.npz", **facts)
    return folder


def counted(ids, width):
    """Frames that hold their own number."""
    return {k: np.full(width, k, np.float32) for k in ids}
