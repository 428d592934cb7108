"""AOT FITS as aotpy reads it back: every number of the telemetry, the matrices, and α over time."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.importers.aot import excerpt, read_telemetry, write_aot
from pyrcal.importers.registration import Dated, affine, registrations_of
from service.archive import Archive
from service.errors import ConfigurationError, MatrixError
from service.files.recording import RecordedKind, Recording, RecordingWriter
from service.model.misregistration import Misregistration
from service.model.pupil import rtc_valid_subapertures
from service.model.slopes import Orientation, SlopeOrder, SlopeRecipe, to_conventions
from service.wire import (
    encode,
    encode_frames,
)
from tests.support.archive_nights import NOON, SECOND, entry
from tests.support.fitted_aot import (
    INSTRUMENT,
    MANIFEST,
    MATRIX,
    N_FRAMES,
    N_SLOPES,
    ROWS,
    STATUS,
    header,
)


@pytest.fixture
def night(tmp_path):
    """A recording of 0.2 s, and an archive that knows α of that night."""
    with RecordingWriter(tmp_path / "night.h5", system="small") as recorder:
        recorder.put(RecordedKind.MATRIX, MATRIX.tobytes(), encode(MANIFEST))
        recorder.put(RecordedKind.STATUS, encode(STATUS))
        for k in range(0, N_FRAMES, 20):
            recorder.put(RecordedKind.FRAMES, *encode_frames(header(k), ROWS[k : k + 20]))
        recorder.put(RecordedKind.FRAMES, b"half a batch", encode(header(0)))
    with Archive(tmp_path / "var") as archive:
        archive.open()
        every = [entry(NOON + k * SECOND, shift_x=0.1 * k) for k in range(5)]
        every[2] = replace(every[2], entered=False)
        archive.record((), (), every)
    return tmp_path


def export(folder, *words):
    where = ("--data-dir", str(folder / "var"), "--instrument", str(folder / "small.toml"))
    return main(["archive", "aot", str(folder / "night.fits"), *where, *words])


@pytest.fixture
def as_configured(night, monkeypatch):
    monkeypatch.setattr("service.instrument.load_instrument", lambda _: INSTRUMENT)
    return night


def test_what_is_written_is_read_back_with_aotpy_bit_for_bit(as_configured, capsys):
    aotpy = pytest.importorskip("aotpy")
    assert export(as_configured, "--recording", str(as_configured / "night.h5")) == 0
    assert "200 frames; 1 damaged messages left out" in capsys.readouterr().err
    system = aotpy.AOSystem.read_from_file(as_configured / "night.fits")
    (sensor,), (mirror,) = system.wavefront_sensors, system.wavefront_correctors
    mask = rtc_valid_subapertures(INSTRUMENT)
    recipe = INSTRUMENT.slopes
    slopes = to_conventions(ROWS[:, :N_SLOPES].T, recipe, mask)
    found = sensor.measurements.data
    assert found.dtype.itemsize == 4
    np.testing.assert_array_equal(found, slopes.reshape(2, -1, N_FRAMES).transpose(2, 0, 1))
    np.testing.assert_array_equal(sensor.measurements.time.frame_numbers, 1000 + np.arange(200))
    np.testing.assert_allclose(np.diff(sensor.measurements.time.timestamps), 1e-3, atol=1e-6)
    first, second = system.loops
    assert (first.uid, second.uid) == ("cm-1", "cm-2")
    assert (first.framerate, first.delay, first.closed) == (1000.0, 2.0, True)
    np.testing.assert_array_equal(first.modal_coefficients.data, ROWS[:100, N_SLOPES:])
    np.testing.assert_array_equal(second.modal_coefficients.data, ROWS[100:, N_SLOPES:])
    assert second.measurements_to_modes is None
    # a matrix is listed as the slopes are: what it makes of them is what the RTC has made
    made = np.einsum("mds,tds->tm", first.measurements_to_modes.data.astype(float), found)
    np.testing.assert_allclose(made, ROWS[:, :N_SLOPES] @ MATRIX.T.astype(float), rtol=1e-5)
    registration = mirror.transformation_matrix
    assert registration.data.shape == (3, 3, 4)
    shifts_m = np.array([0.0, 0.1, 0.3, 0.4]) * INSTRUMENT.subaperture_m
    np.testing.assert_allclose(registration.data[0, 2], shifts_m, rtol=1e-6)
    np.testing.assert_allclose(registration.data[1, 1], 1.002, rtol=1e-6)
    np.testing.assert_allclose(registration.time.timestamps, [NOON / 1e9 + k for k in (0, 1, 3, 4)])
    assert len(mirror.actuator_coordinates) == mirror.n_valid_actuators


@pytest.mark.filterwarnings("ignore:.*contains no data")
def test_a_night_has_alpha_alone(as_configured):
    aotpy = pytest.importorskip("aotpy")
    assert export(as_configured, "--night", "2024-10-04") == 0
    system = aotpy.AOSystem.read_from_file(as_configured / "night.fits")
    assert system.wavefront_correctors[0].transformation_matrix.data.shape == (3, 3, 4)
    assert system.loops == []


def test_a_point_of_the_mirror_lands_where_the_model_has_it():
    alpha = Misregistration(
        shift_x_subap=0.5, shift_y_subap=-0.25, rotation_rad=np.pi / 2, magnification=2.0
    )
    np.testing.assert_allclose(affine(alpha, 0.4) @ [1.0, 0.0, 1.0], [0.2, 1.9, 1.0], atol=1e-12)


def test_the_rtcs_own_listing_is_told_in_our_axes():
    from pyrcal.importers.aot import _as_listed

    turned = Orientation(swap_xy=True, sign_x=-1)
    recipe = SlopeRecipe(order=SlopeOrder.INTERLEAVED, orientation=turned)
    instrument = replace(INSTRUMENT, slopes=recipe)
    mask = rtc_valid_subapertures(instrument)
    ours = to_conventions(
        ROWS[:, :N_SLOPES].T, SlopeRecipe(order=recipe.order, orientation=turned), mask
    ).T
    found = _as_listed(ROWS[:, :N_SLOPES], instrument)
    np.testing.assert_array_equal(found.reshape(N_FRAMES, -1), ours)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "expected --night DATE for α alone, or --recording FILE"),
        (("--night", "2024-10-05"), "2024-10-05: nothing was measured in this night"),
        (("--recording", "none.h5"), "none.h5: cannot be read"),
        (("--recording", "{}/night.h5", "--skip", "9"), "found no frames from 9 s on for 10 s"),
    ],
)
def test_what_cannot_be_exported_is_said(as_configured, capsys, words, said):
    assert export(as_configured, *(word.format(as_configured) for word in words)) == 2
    assert said in capsys.readouterr().err
    assert not (as_configured / "night.fits").exists()


def test_without_aotpy_it_says_what_to_install(as_configured, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "aotpy", None)
    assert export(as_configured, "--night", "2024-10-04") == 2
    assert "pip install 'pyrcal[aot]'" in capsys.readouterr().err


def test_a_file_that_is_there_is_not_written_over(as_configured, capsys):
    pytest.importorskip("aotpy")
    (as_configured / "night.fits").write_bytes(b"mine")
    assert export(as_configured, "--night", "2024-10-04") == 2
    assert "exists already" in capsys.readouterr().err
    assert (as_configured / "night.fits").read_bytes() == b"mine"


def test_a_recording_of_another_version_is_refused(tmp_path):
    import h5py

    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.attrs.update(format="pyrcal-telemetry", version=9)
    with pytest.raises(ConfigurationError, match="expected"), Recording(tmp_path / "x.h5"):
        pass


# --- and back


def dated(n=4, **more):
    rng = np.random.default_rng(3)
    for k in range(n):
        x, y, turn, size = rng.uniform([-2, -2, -3.1, 0.9], [2, 2, 3.1, 1.1])
        stretch = tuple(rng.uniform(-0.03, 0.03, 2)) if k % 2 else None
        alpha = Misregistration(
            shift_x_subap=x,
            shift_y_subap=y,
            rotation_rad=turn,
            magnification=size,
            anamorphosis=stretch,
        )
        yield Dated(t_ns_utc=NOON + k * SECOND + 123_456_789, alpha=alpha, **more)


@pytest.mark.filterwarnings("ignore:.*contains no data")
def test_telemetry_and_alpha_come_back_and_go_out_again_the_same(night):
    aotpy = pytest.importorskip("aotpy")
    given = tuple(dated())
    write_aot(night / "a.fits", INSTRUMENT, given, excerpt(night / "night.h5", 0.0, 10.0))
    found = read_telemetry(night / "a.fits", INSTRUMENT)
    assert found.notes == ["one loop is played; left out: cm-2"]
    arrays = found.arrays
    np.testing.assert_array_equal(arrays["slopes"], ROWS[:100, :N_SLOPES])
    np.testing.assert_array_equal(arrays["commands_m"], ROWS[:100, N_SLOPES:])
    np.testing.assert_array_equal(arrays["reconstructor"], MATRIX)
    np.testing.assert_array_equal(arrays["seq"], 1000 + np.arange(100))
    assert (arrays["frame_rate_hz"], arrays["delay_frames"]) == (1000.0, 2.0)
    assert abs(arrays["t0_ns_utc"] - NOON) < 240
    for before, after in zip(given, found.registrations, strict=True):
        assert abs(after.t_ns_utc - before.t_ns_utc) < 240
        np.testing.assert_allclose(after.alpha.vector, before.alpha.vector, rtol=0, atol=1e-14)
        np.testing.assert_allclose(after.alpha.stretches, before.alpha.stretches, atol=1e-14)
    write_aot(night / "b.fits", INSTRUMENT, found.registrations, None)
    once, twice = (aotpy.AOSystem.read_from_file(night / f"{k}.fits") for k in "ab")
    once, twice = (one.wavefront_correctors[0].transformation_matrix for one in (once, twice))
    np.testing.assert_allclose(twice.data, once.data, rtol=0, atol=1e-14)
    assert twice.time.timestamps == once.time.timestamps


def image(data, **more):
    aotpy = pytest.importorskip("aotpy")
    return aotpy.Image("registration", np.asarray(data, float), **more)


def test_a_mirror_that_is_seen_from_behind_has_its_parity():
    (given,) = dated(1)
    matrix = affine(given.alpha, 0.4) @ np.diag([1.0, -1.0, 1.0])
    found = registrations_of(image(matrix), 0.4, "it")
    assert found.parity == -1
    assert found.mirror["parity"] == -1
    np.testing.assert_allclose(found.over_time[0].alpha.vector, given.alpha.vector, atol=1e-14)
    assert found.over_time[0].t_ns_utc is None
    assert "registration_t_ns_utc" not in found.arrays


def test_a_shear_is_a_stretch_of_the_turned_image():
    matrix = np.eye(3)
    matrix[0, 1] = 0.02
    (at,) = registrations_of(image(matrix), 0.4, "it").over_time
    np.testing.assert_allclose(affine(at.alpha, 0.4), matrix, atol=1e-14)
    assert at.alpha.rotation_rad == pytest.approx(-0.01, abs=1e-6)


EYES = np.stack([np.eye(3)] * 4, axis=-1)
MIRRORED_ONCE = EYES * 1.0
MIRRORED_ONCE[1, 1, 2] = -1.0
MOVED = np.eye(3) + np.outer([1.0, 0.0, 0.0], [0.0, 0.0, 0.3])


@pytest.mark.parametrize(
    ("data", "more", "said"),
    [
        (EYES, {"unit": "mm"}, "found the unit mm, expected metres"),
        (np.moveaxis(EYES, -1, 0), {}, r"found shape \(4, 3, 3\), expected \(3, 3, t\)"),
        (EYES * np.nan, {}, "not finite"),
        (MOVED.T, {}, r"last row \[0.3, 0.0, 1.0\], expected 0 0 1"),
        (MIRRORED_ONCE, {}, "expected one parity"),
        (np.diag([1.0, 0.0, 1.0]), {}, "leaves no image"),
        (np.diag([1.0, 0.5, 1.0]), {}, "stretched by 0.33, expected at most 0.2"),
    ],
)
def test_matrices_that_no_alpha_is_are_refused_in_one_line(data, more, said):
    with pytest.raises(MatrixError, match=said) as refused:
        registrations_of(image(data, **more), 0.4, "it")
    assert "\n" not in str(refused.value)


def test_another_number_of_times_is_refused():
    aotpy = pytest.importorskip("aotpy")
    time = aotpy.Time(uid="t", timestamps=[1.0, 2.0])
    with pytest.raises(MatrixError, match="found 2 times of 4 matrices"):
        registrations_of(image(EYES, time=time), 0.4, "it")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: setattr(s.wavefront_sensors[0].measurements, "unit", "rad"), "the unit rad"),
        (lambda s: setattr(s.loops[0].modal_coefficients, "unit", "V"), "the unit V"),
        (lambda s: setattr(s.loops[0], "framerate", None), "found no framerate"),
        (lambda s: setattr(s.wavefront_sensors[0], "subaperture_mask", None), "no subaperture"),
        (lambda s: setattr(s.loops[0].modal_coefficients, "time", None), "0 and 0 of 100 commands"),
    ],
)
def test_telemetry_that_is_of_something_else_is_refused(night, monkeypatch, change, said):
    aotpy = pytest.importorskip("aotpy")
    write_aot(night / "a.fits", INSTRUMENT, (), excerpt(night / "night.h5", 0.0, 10.0))
    system = aotpy.AOSystem.read_from_file(night / "a.fits")
    change(system)
    monkeypatch.setattr("pyrcal.importers.aot.read_system", lambda _: system)
    with pytest.raises(MatrixError, match=said):
        read_telemetry(night / "a.fits", INSTRUMENT)


def test_what_others_list_and_scale_otherwise_is_read_the_same(night, monkeypatch):
    """Subapertures in another order, which the mask says; commands in nanometres."""
    aotpy = pytest.importorskip("aotpy")
    write_aot(night / "a.fits", INSTRUMENT, (), excerpt(night / "night.h5", 0.0, 10.0))
    expected = read_telemetry(night / "a.fits", INSTRUMENT).arrays
    system = aotpy.AOSystem.read_from_file(night / "a.fits")
    (sensor,) = system.wavefront_sensors
    mask = sensor.subaperture_mask.data
    order = np.random.default_rng(4).permutation(N_SLOPES // 2)  # what was k is listed at order[k]
    mask = np.where(mask >= 0, order[mask], -1)
    sensor.subaperture_mask.data = mask
    back = np.argsort(order)
    sensor.measurements.data = sensor.measurements.data[..., back]
    control, commands = system.loops[0].measurements_to_modes, system.loops[0].modal_coefficients
    control.data = control.data[..., back]
    commands.data, commands.unit = commands.data.astype(float) * 1e9, "nm"
    monkeypatch.setattr("pyrcal.importers.aot.read_system", lambda _: system)
    found = read_telemetry(night / "a.fits", INSTRUMENT).arrays
    for name in ("slopes", "reconstructor", "seq"):
        np.testing.assert_array_equal(found[name], expected[name])
    np.testing.assert_allclose(found["commands_m"], expected["commands_m"], rtol=1e-12)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "it.fits: cannot be read: No such file or directory"),
        (b"hello", "it.fits: found no FITS, expected an AOT file"),
        (
            b"SIMPLE  =                    T",
            "it.fits: found FITS without AOT-VERS, expected an AOT",
        ),
    ],
)
def test_what_is_no_aot_file_is_said_in_a_few_words(tmp_path, content, said):
    pytest.importorskip("aotpy")
    if content is not None:
        (tmp_path / "it.fits").write_bytes(content)
    with pytest.raises(MatrixError, match=said):
        read_telemetry(tmp_path / "it.fits", INSTRUMENT)
