"""Telemetry of any recorder, through the estimators: what comes out, and what is refused."""

import contextlib
import io
import json

import h5py
import numpy as np
import pytest
from astropy.io import fits

import pyrcal
from pyrcal.__main__ import main
from pyrcal_studies.campaign.night import LINE_FRACTIONS
from pyrcal_studies.campaign.observatory import SMALL, Dome
from service.instrument import load_instrument
from service.model.misregistration import BOUNDARY_SCALE
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options

RATE_HZ = 1000.0
TRUE = {
    "shift_x_subap": 0.12,
    "shift_y_subap": -0.08,
    "rotation_deg": 0.3,
    "magnification": 1.004,
}
N_CONTROLLED = 45
MODES = (50, 55, 60, 65)
AMPLITUDE_M = 10e-9
SECONDS = 9


@pytest.fixture(scope="module")
def telemetry():
    """A loop of the small telescope as its recorder has it, with sines from its first frame on."""
    words = ["--instrument", SMALL, f"--n-controlled={N_CONTROLLED}", "--seed=3", "--mag=8"]
    words.append("--alpha=" + ",".join(str(value) for value in TRUE.values()))
    telescope = build_telescope(parse_options(words), load_instrument(SMALL))
    computer = telescope.computer(telescope.feed.blocks())
    computer.prepare()
    sines = {
        "dither_modes": np.array(MODES),
        "dither_frequencies_hz": np.array(
            [round(f * RATE_HZ) for f in LINE_FRACTIONS[: len(MODES)]], float
        ),
        "dither_amplitude_m": np.full(len(MODES), AMPLITUDE_M),
    }
    start_seq = dithered(computer, sines)
    batches = []
    while not batches or batches[-1].seq0 < start_seq + SECONDS * RATE_HZ:
        batches.append(computer.next_batch())
    begun = [b for b in batches if b.dither_m is not None and b.seq0 >= start_seq]
    settings = telescope.settings
    return sines | {
        "slopes": np.concatenate([b.slopes for b in begun]),
        "commands_m": np.concatenate([b.commands_m for b in begun]),
        "dither_m": np.concatenate([b.dither_m for b in begun]),
        "reconstructor": telescope.reconstructor.matrix,
        "gains": np.array(settings.gains),
        "frame_rate_hz": np.array(RATE_HZ),
        "delay_frames": np.array(settings.delay_frames),
        "leak": np.array(settings.leak),
    }


def dithered(computer, sines):
    from service.wire import DitherKind, DitherRequest

    computer.next_batch()
    reply = computer.execute(
        DitherRequest(
            id="sines",
            kind=DitherKind.SINE,
            modes=MODES,
            amplitude_m=tuple(sines["dither_amplitude_m"]),
            frequency_hz=tuple(sines["dither_frequencies_hz"]),
            duration_s=SECONDS + 5.0,
        )
    )
    return reply.start_seq


def saved(folder, arrays):
    path = folder / "night.npz"
    np.savez(path, **arrays)
    return path


def tracked(capsys, path, *words):
    status = main(["track", SMALL, str(path), "--json", *words])
    out, err = capsys.readouterr()
    return status, json.loads(out) if out else None, err


@pytest.fixture(scope="module")
def answer(telemetry, tmp_path_factory):
    """The folder with what is written of the whole file, and what is printed of it."""
    folder, out = tmp_path_factory.mktemp("whole"), io.StringIO()
    words = [f"--output={folder / 'track.h5'}", f"--plot={folder / 'track.png'}"]
    with contextlib.redirect_stdout(out):
        assert main(["track", SMALL, str(saved(folder, telemetry)), "--json", *words]) == 0
    return folder, json.loads(out.getvalue())


def cut(telemetry, n=1500):
    """The first frames, of a dither that stays as it is described."""
    per_frame = ("slopes", "commands_m", "dither_m")
    return {name: values[:n] if name in per_frame else values for name, values in telemetry.items()}


def test_sines_in_an_npz_give_alpha(answer):
    folder, found = answer
    h5, png = folder / "track.h5", folder / "track.png"
    entries = [entry for entry in found["entries"] if entry["source"] == "lock-in"]
    assert len(entries) >= 1
    for name, value in TRUE.items():
        # what the simulator's mirror is off the drawing turns and scales 144 actuators by 7e-4
        floor = {"rotation_deg": 0.04, "magnification": 0.0015}.get(name, 0.01)
        error = found["alpha"][name] - value
        assert abs(error) < 3.0 * np.hypot(entries[-1]["measured_sigma"][name], floor)
    assert png.stat().st_size > 10_000
    with h5py.File(h5) as file:
        np.testing.assert_array_equal(
            file["t_ns_utc"][()], [entry["t_ns_utc"] for entry in found["entries"]]
        )
        assert file["measured"].shape == (len(found["entries"]), 4)


async def test_the_library_takes_names_and_gives_arrays(telemetry, tmp_path):
    """In a running event loop, as in a notebook."""
    found = pyrcal.track(str(saved(tmp_path, telemetry)), str(SMALL))
    assert found.t.shape == (len(found.entries),)
    assert found.alpha.shape == found.sigma.shape == (len(found.entries), 4)
    np.testing.assert_allclose(found.alpha[-1], found.entries[-1].filtered.vector * BOUNDARY_SCALE)
    assert 0.0 < found.t[0] < SECONDS
    found.plot("a night").savefig(tmp_path / "night.png")
    assert (tmp_path / "night.png").stat().st_size > 10_000


def test_hdf5_says_the_same_as_npz(telemetry, answer, tmp_path, capsys):
    path = tmp_path / "night.h5"
    numbers = ("frame_rate_hz", "delay_frames", "leak")
    with h5py.File(path, "w") as file:
        for name, values in telemetry.items():
            if name in numbers:
                file.attrs[name] = float(values)
            else:
                file[name] = values
    _, found, _ = tracked(capsys, path)
    assert found["entries"] == answer[1]["entries"]
    assert found["entries"]


def test_a_file_of_matlab_says_the_same_as_npz(telemetry, answer, tmp_path, capsys):
    path = tmp_path / "night.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in telemetry.items():
            file[name] = np.atleast_2d(values).T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    _, found, _ = tracked(capsys, path)
    assert found["entries"] == answer[1]["entries"]


@pytest.mark.parametrize("name", ["cube.fits", "cube.txt", "."])
def test_a_cube_with_its_timing_file_is_refused_with_what_is_missing(name, tmp_path, capsys):
    fits.writeto(tmp_path / "cube.fits", np.zeros((5, 4, 4), np.float32))
    (tmp_path / "cube.txt").write_text("0 0.001 1700000000.001\n1 0.002 1700000000.002\n")
    status, _, err = tracked(capsys, tmp_path / name)
    assert status == 2
    assert all(missing in err for missing in ("slopes", "commands_m", "frame_rate_hz"))


def test_commands_as_asked_that_the_mirror_clipped_are_named(tmp_path, capsys):
    words = [f"--instrument={SMALL}", f"--n-controlled={N_CONTROLLED}", "--seed=3", "--mag=8"]
    limits = ("--rate=500", "--actuator-stroke=1.2", "--actuator-bend=100", "--report-asked")
    dome = Dome([*words, "--seeing=0.8", *limits])
    blocks = [block for _ in range(40) for block in dome.play()]
    settings = dome.telescope.settings
    path = saved(
        tmp_path,
        {
            "slopes": np.concatenate([block.slopes for block in blocks]),
            "commands_m": np.concatenate([block.commands_m for block in blocks]),
            "reconstructor": dome.telescope.reconstructor.matrix,
            "gains": np.array(settings.gains),
            "frame_rate_hz": np.array(500.0),
            "delay_frames": np.array(settings.delay_frames),
            "leak": np.array(settings.leak),
        },
    )
    _, found, _ = tracked(capsys, path)
    assert "commands-not-played" in {alarm["name"] for alarm in found["alarms"]}
    # the integrator obeys its law, so that the check of the law finds nothing
    assert "commands-off-loop" not in {alarm["name"] for alarm in found["alarms"]}


def test_without_a_dither_it_says_what_ordinary_telemetry_says(telemetry, tmp_path, capsys):
    plain = {k: v for k, v in telemetry.items() if not k.startswith("dither")}
    status, found, _ = tracked(capsys, saved(tmp_path, plain))
    assert status == 1
    assert found["alpha"] is None
    assert found["passive"][-1]["sigma"]["shift_x_subap"] > 0.05  # nothing is made from it alone
    assert main(["track", SMALL, str(saved(tmp_path, cut(plain)))]) == 1
    assert "alpha was not found: no dithered window" in capsys.readouterr().out


def test_a_rest_of_a_second_does_not_outdo_the_estimates_before_it(telemetry, tmp_path, capsys):
    """Looks are of four seconds; what is left over knows less, and is the last to be told."""
    plain = {k: v for k, v in telemetry.items() if not k.startswith("dither")}
    _, found, _ = tracked(capsys, saved(tmp_path, cut(plain, 5000)))
    assert len(found["passive"]) == 1


def test_a_file_too_short_for_one_look_gives_what_it_can(telemetry, tmp_path, capsys):
    plain = {k: v for k, v in telemetry.items() if not k.startswith("dither")}
    _, found, _ = tracked(capsys, saved(tmp_path, cut(plain)))
    assert len(found["passive"]) == 1


def without(name):
    return lambda arrays: arrays.pop(name)


def counted(numbers):
    return lambda arrays: arrays.update(seq=numbers(len(arrays["slopes"])))


def set_in(name, place, value):
    def spoil(arrays):
        arrays[name] = arrays[name].astype(float)
        arrays[name][place] = value

    return spoil


def given(name, change):
    return lambda arrays: arrays.update({name: change(arrays[name])})


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (without("slopes"), "slopes: found no such array among"),
        (without("commands_m"), "commands_m: found no such array among"),
        (without("frame_rate_hz"), "frame_rate_hz: found no such number"),
        (given("frame_rate_hz", lambda v: -v), "frame_rate_hz: found -1000"),
        (given("slopes", lambda v: v.T), "commands_m: found float32 of shape"),
        (given("commands_m", lambda v: v[:-1]), "commands_m: found float32 of shape"),
        (given("commands_m", lambda v: np.hstack([v, v])), "expected at most the basis's 90"),
        (given("dither_m", lambda v: v[:, :7]), "dither_m: found float32 of shape"),
        (given("reconstructor", lambda v: v.T), "reconstructor: found float32 of shape"),
        (given("gains", lambda v: v[:4]), "gains: found 4 numbers, expected one number, 45 or 90"),
        (given("dither_modes", lambda v: v[:2]), "dither_modes: found 2 modes, 4 frequencies"),
        (given("slopes", lambda v: v.astype("S3")), "slopes: found |S3 of shape"),
        (lambda arrays: arrays.update(seq=np.zeros(7)), "seq: found float64 of shape (7,)"),
        (counted(lambda n: np.arange(n) - 5), "seq: found -5 in row 0"),
        (counted(lambda n: np.arange(n) + 0.5), "seq: found 0.5 in row 0"),
        (counted(lambda n: 2.0**53 + 2.0 * np.arange(n)), "seq: found 9007199254740994 in row 1"),
        (counted(lambda n: np.arange(n, dtype=np.uint64) + 2**63), "found 9223372036854775808"),
        (counted(lambda n: np.r_[np.arange(n - 1), 7]), "seq: found 7 in row 1499 after 1498"),
        (set_in("reconstructor", (7, 3), np.nan), "reconstructor: found nan in row 7, column 3"),
        (set_in("reconstructor", 7, np.nan), "reconstructor: found nan in row 7, column 0"),
        (set_in("reconstructor", (7, 3), 1e30), "reconstructor: found 1e+30 in row 7, column 3"),
        (set_in("slopes", np.s_[:, 3], np.nan), "slopes: found nan in row 0, column 3"),
        (set_in("commands_m", np.s_[:, 4], -np.inf), "commands_m: found -inf in row 0, column 4"),
        (set_in("dither_m", np.s_[:, 2], 1e300), "dither_m: found 1e+300 in row 0, column 2"),
        (set_in("dither_modes", 3, 90), "dither_modes: found 90 in row 3"),
        (set_in("dither_modes", 0, -1), "dither_modes: found -1 in row 0"),
        (given("dither_modes", lambda v: v + 1), "dither_modes: found 51 in row 0"),
        (set_in("dither_modes", 1, 50), "expected each mode once"),
        (set_in("dither_frequencies_hz", 2, 500.0), "dither_frequencies_hz: found 500 in row 2"),
        (set_in("dither_amplitude_m", 1, 0.0), "dither_amplitude_m: found 0 in row 1"),
        (set_in("gains", 8, np.nan), "gains: found nan in row 8"),
        (given("leak", lambda _: 1.5), "leak: found 1.5, expected a number from 0 to 1"),
        (given("delay_frames", lambda _: 1e9), "delay_frames: found 1e+09"),
        (lambda arrays: arrays.update(t0_ns_utc=1e19), "t0_ns_utc: found 1e+19"),
        (given("frame_rate_hz", lambda _: 1e-3), "frame_rate_hz: found 0.001"),
    ],
)
def test_what_does_not_fit_is_named(telemetry, tmp_path, capsys, spoil, text):
    arrays = cut(telemetry)
    spoil(arrays)
    status, found, err = tracked(capsys, saved(tmp_path, arrays))
    assert (status, found) == (2, None)
    assert text in err
    assert "Traceback" not in err


def test_frame_numbers_beyond_what_a_double_holds_are_taken_as_they_are(
    telemetry, tmp_path, capsys
):
    far = cut(telemetry, 500) | {"seq": 2**53 + 1 + np.arange(500)}
    _, found, _ = tracked(capsys, saved(tmp_path, far))
    assert (found["n_frames"], found["n_missing"]) == (500, 0)


def test_frames_that_are_not_finite_are_left_out_and_named(telemetry, tmp_path, capsys):
    spoilt = dict(telemetry)
    for name, rows in {"slopes": [100, 101, 3000], "commands_m": [2500]}.items():
        spoilt[name] = telemetry[name].copy()
        spoilt[name][rows, 5] = np.nan
    status, found, err = tracked(capsys, saved(tmp_path, spoilt))
    assert status == 0
    assert found["n_missing"] == 4
    assert "slopes: found nan in row 100, column 5; 4 of 9010 frames" in err
    assert "lock-in" in {entry["source"] for entry in found["entries"]}


@pytest.mark.parametrize("delay", [0.5, 10.9, 11.0, 100.0])
def test_a_delay_beyond_the_filter_gives_no_estimate(telemetry, tmp_path, capsys, delay):
    arrays = cut(telemetry) | {"delay_frames": np.array(delay)}
    status, found, _ = tracked(capsys, saved(tmp_path, arrays))
    assert status == 1
    assert not found["passive"] or 2.0 <= delay < 11.0


def test_frames_that_are_missing_are_told_by_their_numbers(telemetry, tmp_path, capsys):
    keep = np.ones(len(telemetry["slopes"]), bool)
    keep[1500:1600] = False
    holed = dict(telemetry) | {"seq": np.flatnonzero(keep)}
    for name in ("slopes", "commands_m", "dither_m"):
        holed[name] = telemetry[name][keep]
    _, found, _ = tracked(capsys, saved(tmp_path, holed))
    assert found["n_frames"] == keep.sum()
    assert found["n_missing"] == len(keep) - keep.sum()
    assert found["last_ns_utc"] - found["first_ns_utc"] == (len(keep) - 1) * 1_000_000


@pytest.mark.parametrize(
    "fill", [b"", b"PK\x03\x04 no zip", b"SIMPLE  = T", b"\x89HDF\r\n\x1a\nno", b"text"]
)
def test_other_files_are_refused_in_one_line(tmp_path, capsys, fill):
    path = tmp_path / "night"
    path.write_bytes(fill)
    status, _, err = tracked(capsys, path)
    assert status == 2
    assert str(path) in err
    assert "Traceback" not in err
    assert err.count("\n") == 1


def test_an_aot_file_is_played_and_its_own_alpha_is_compared(telemetry, tmp_path, capsys):
    pytest.importorskip("aotpy")
    from pyrcal.importers.aot import Excerpt, read_telemetry, write_aot
    from pyrcal.importers.registration import Dated
    from service.model.misregistration import Misregistration
    from service.wire import FrameBatch, FrameHeader

    n, instrument = 400, load_instrument(SMALL)
    slopes, commands_m = (telemetry[name][:n] for name in ("slopes", "commands_m"))
    header = FrameHeader(
        session="s",
        seq0=7,
        n=n,
        t0_ns=1_790_000_000_000_000_000,
        dt_ns=1_000_000,
        n_slopes=slopes.shape[1],
        n_modes=commands_m.shape[1],
        dither=False,
        cm_id="cm",
        basis_id="",
        config_id="",
    )
    control = telemetry["reconstructor"].astype(np.float32)
    rows = np.hstack([slopes, commands_m]).astype(np.float32)
    taken = Excerpt(batches=[FrameBatch(header=header, rows=rows)], matrices={"cm": control})
    told = Dated(t_ns_utc=header.t0_ns, alpha=Misregistration.from_boundary(TRUE))
    path = tmp_path / "night.fits"
    write_aot(path, instrument, [told], taken)
    np.testing.assert_array_equal(read_telemetry(path, instrument).arrays["slopes"], slopes)
    _, found, _ = tracked(capsys, path)
    assert found["n_frames"] == n
    assert found["stated"][0]["alpha"] == pytest.approx(TRUE)
    write_aot(tmp_path / "alpha.fits", instrument, [told], None)
    status, _, said = tracked(capsys, tmp_path / "alpha.fits")
    assert status == 2
    assert "found no slopes with commands" in said


@pytest.mark.parametrize("frames", [3, -2])
def test_streams_that_are_frames_apart_are_said_to_be_so_and_no_sign_is_blamed(
    telemetry, tmp_path, capsys, frames
):
    n = len(telemetry["slopes"]) - abs(frames)
    first = {"slopes": max(frames, 0), "commands_m": max(-frames, 0), "dither_m": max(-frames, 0)}
    moved = {
        name: values[first.get(name, 0) :][:n]
        for name, values in telemetry.items()
        if name != "reconstructor" and values.ndim == 2
    }
    others = {name: values for name, values in telemetry.items() if values.ndim < 2}
    path = saved(tmp_path, others | moved)
    assert main(["track", SMALL, str(path)]) == 1
    said = capsys.readouterr().out
    assert f"commands change {2 + frames} frames after" in said
    assert f"{abs(frames)} frames apart" in said
    assert "modes-contrary" not in said


def test_streams_of_the_same_frames_are_not_said_to_be_apart(answer):
    assert answer[1]["misaligned"] is None
