"""Sessions of pyRTC's recorder: commands are paired with exposures by frame ids."""

import numpy as np
import pytest

from pyrcal.playback.arrays import Arrays
from pyrcal.playback.pyrtc import is_session, read_session
from service.errors import ConfigurationError, MatrixError
from service.instrument import load_instrument
from tests.support.night import INSTRUMENT
from tests.support.pyrtc import N_MODES, N_SLOPES, counted, session_in

SMALL = load_instrument(INSTRUMENT)


def test_each_exposure_has_the_command_that_was_on_the_mirror(tmp_path):
    ids = range(100, 160)
    folder = session_in(
        tmp_path / "s", signals=counted(ids, N_SLOPES), commands=counted(ids, N_MODES)
    )
    assert is_session(folder)
    assert is_session(folder / "session.json")
    found = read_session(folder, SMALL)
    np.testing.assert_array_equal(found["seq"], np.arange(102, 160))
    np.testing.assert_array_equal(found["slopes"][:, 0], found["seq"])
    np.testing.assert_array_equal(found["commands_m"][:, 0], found["seq"] - 2)
    assert found["frame_rate_hz"] == pytest.approx(500.0, rel=1e-6)


@pytest.mark.parametrize("delay", [1.0, 1.3, 2.7, 3.0])
def test_a_delay_between_two_frames_is_the_mean_over_the_exposure(tmp_path, delay):
    ids, facts = range(60), {"delay_frames": delay, "leak": 0.99, "frame_rate_hz": 1000.0}
    folder = session_in(
        tmp_path / "s", signals=counted(ids, N_SLOPES), commands=counted(ids, N_MODES), facts=facts
    )
    found = read_session(folder, SMALL)
    np.testing.assert_allclose(found["commands_m"][:, 0], found["seq"] - delay)
    assert (found["leak"], found["frame_rate_hz"]) == (0.99, 1000.0)


def test_exposures_whose_command_is_missing_are_left_out_and_one_told_twice_counts_once(tmp_path):
    signals, commands = counted(range(20), N_SLOPES), counted(range(20), N_MODES)
    del commands[7], signals[12]
    folder = session_in(tmp_path / "s", signals=signals, commands=commands)
    ids = folder / "bench-signal" / "frame_ids.npy"
    told = np.load(ids)
    told[4] = told[3]
    np.save(ids, told)
    seq = read_session(folder, SMALL)["seq"]
    assert seq.tolist() == [k for k in range(2, 20) if k not in {4, 9, 12}]


BAD = {
    "another number of modes": (
        {"commands": counted(range(9), 200)},
        "found 200 numbers a frame, expected at most the 90 modes",
    ),
    "other exposures": ({"commands": counted(range(50, 59), N_MODES)}, "expected some of the same"),
    "a name that is none": ({"name": "wfs"}, "found the streams wfs, wfs, expected one of signal"),
    "a path out of it": ({"frames_file": "../../x.npy"}, "expected a file in it"),
    "no ids": ({"frame_ids_file": "nowhere.npy"}, "cannot be read"),
    "two delays": ({"facts": {"delay_frames": [2.0, 3.0]}}, "expected 1 to 20"),
    "a delay": ({"facts": {"delay_frames": 0.2}}, "delay_frames: found 0.2, expected 1 to 20"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_used_is_said_in_one_line(tmp_path, what):
    changes, told = BAD[what]
    given = {"signals": counted(range(9), N_SLOPES), "commands": counted(range(9), N_MODES)}
    folder = session_in(tmp_path / "s", **given | changes)
    with pytest.raises(ConfigurationError, match=told) as error:
        read_session(folder, SMALL)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("facts", "match"),
    [
        ({"reconstructor": np.full((3, N_SLOPES), np.nan)}, "reconstructor: found nan in row 0"),
        ({"leak": np.array(np.nan)}, "leak: found nan"),
        (
            {
                "dither_modes": np.array([5, 6]),
                "dither_frequencies_hz": np.array([50.0, 60.0]),
                "dither_amplitude_m": np.full(2, 1e-8),
            },
            "dither_modes: found 6 in row 1",
        ),
    ],
)
def test_what_the_loop_says_beside_it_is_checked_as_any_telemetry(tmp_path, facts, match):
    ids = range(60)
    folder = session_in(
        tmp_path / "s", signals=counted(ids, N_SLOPES), commands=counted(ids, N_MODES), facts=facts
    )
    arrays = Arrays(path=folder, found=read_session(folder, SMALL))
    with pytest.raises(ConfigurationError, match=match):
        list(arrays.messages(SMALL))


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04 cut off"])
def test_facts_that_cannot_be_read_are_refused(tmp_path, content):
    given = {"signals": counted(range(9), N_SLOPES), "commands": counted(range(9), N_MODES)}
    folder = session_in(tmp_path / "s", **given)
    (folder / "loop.npz").write_bytes(content)
    with pytest.raises(MatrixError, match=r"loop\.npz"):
        read_session(folder, SMALL)


@pytest.mark.parametrize("text", ["", "[]", '{"streams": 3}', '{"streams": [7]}'])
def test_a_manifest_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "session.json").write_text(text)
    with pytest.raises(ConfigurationError, match=r"session\.json: is no session of pyRTC 2"):
        read_session(tmp_path, SMALL)


def test_frames_that_were_cut_off_are_named(tmp_path):
    given = {"signals": counted(range(9), N_SLOPES), "commands": counted(range(9), N_MODES)}
    folder = session_in(tmp_path / "s", **given)
    path = folder / "bench-wfc" / "frames.npy"
    path.write_bytes(path.read_bytes()[:150])
    with pytest.raises(ConfigurationError, match=r"frames\.npy: cannot be read"):
        read_session(folder, SMALL)
