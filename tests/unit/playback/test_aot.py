"""An AOT file that somebody has written by hand, from the standard alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from pyrcal.importers.aot import read_telemetry
from pyrcal.playback.arrays import Arrays
from pyrcal_studies.campaign.observatory import SMALL
from service.errors import ConfigurationError, MatrixError
from service.instrument import load_instrument
from service.model.slopes import Orientation
from tests.support.played_aot import N_CONTROLLED, RATE_HZ, RNG, SEQ, Hand, N, aotpy


@pytest.fixture(scope="module")
def small():
    return load_instrument(SMALL)


@pytest.fixture(scope="module")
def with_strokes(small):
    """The same with modes of its user's own: 20 combinations of its actuators."""
    strokes = np.linalg.qr(RNG.normal(size=(len(small.mirror.positions_m), 20)))[0]
    return replace(small, mirror=replace(small.mirror, mode_to_actuator=strokes))


def test_signals_of_somebody_elses_file_are_as_its_instrument_lists_them(small, tmp_path):
    """Only files of pyrcal's own have the axes of conventions: these have their RTC's already."""
    turned = replace(small, slopes=replace(small.slopes, orientation=Orientation(sign_x=-1)))
    hand = Hand(turned)
    night = hand.read(tmp_path, turned)
    np.testing.assert_array_equal(night.arrays["slopes"], hand.slopes.reshape(N, -1))
    flat = hand.control.reshape(N_CONTROLLED, -1)
    np.testing.assert_array_equal(night.arrays["reconstructor"], flat)
    np.testing.assert_array_equal(night.arrays["commands_m"], hand.modal_m)
    assert night.arrays["delay_frames"] == 1.5
    assert night.notes == []


def test_of_several_sensors_the_one_with_the_instruments_mask_is_played(small, tmp_path):
    hand = Hand(small)
    other = aotpy.Pyramid(
        uid="other",
        n_sides=4,
        source=aotpy.NaturalGuideStar("other star"),
        n_valid_subapertures=4,
        subaperture_mask=aotpy.Image("other mask", np.arange(4).reshape(2, 2)),
        measurements=aotpy.Image("other slopes", np.zeros((N, 2, 4), np.float32), time=hand.time),
    )
    hand.others = [other]
    night = hand.read(tmp_path, small)
    np.testing.assert_array_equal(night.arrays["slopes"], hand.slopes.reshape(N, -1))
    assert any("2 sensors" in note for note in night.notes)
    hand.sensor.subaperture_mask, hand.others = other.subaperture_mask, []
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    with pytest.raises(MatrixError, match=r"found the sensors sensor \(Pyramid, 4 subapertures\)"):
        hand.read(other_folder, small)


def test_frames_without_numbers_are_counted_by_their_times(small, tmp_path):
    hand = Hand(small)
    hand.time.frame_numbers = []
    night = hand.read(tmp_path, small)
    np.testing.assert_array_equal(np.diff(night.arrays["seq"]), np.diff(SEQ))
    assert night.notes == ["frames have no numbers: counted by their times"]


def test_frames_without_numbers_and_times_are_all_there_are_and_it_is_said(small, tmp_path):
    hand = Hand(small)
    hand.sensor.measurements.time = hand.loop.modal_coefficients.time = None
    night = hand.read(tmp_path, small)
    np.testing.assert_array_equal(night.arrays["seq"], np.arange(N))
    assert "neither numbers nor times" in night.notes[0]


@pytest.mark.parametrize("stamps", [[0.0, 1.0, 1.4, 3.0, 4.0, 5.0], [0.0, 1.0, 1.0, 3.0, 4.0, 5.0]])
def test_times_off_the_rate_or_twice_in_a_frame_are_refused(stamps, small, tmp_path):
    hand = Hand(small)
    hand.time.frame_numbers = []
    hand.time.timestamps = [stamp / RATE_HZ for stamp in stamps]
    with pytest.raises(MatrixError, match="of a frame off the loop's 500 Hz"):
        hand.read(tmp_path, small)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (
            lambda hand: hand.control.__setitem__((2, 1, 4), np.nan),
            "reconstructor: found nan in row 2",
        ),
        (lambda hand: hand.slopes.__setitem__((slice(None), 0, 3), np.inf), "slopes: found inf"),
        (lambda hand: hand.modal_m.__setitem__((slice(None), 7), np.nan), "commands_m: found nan"),
        (lambda hand: hand.time.timestamps.__setitem__(0, np.nan), "times that are not finite"),
        (lambda hand: setattr(hand.loop, "delay", -1.0), "delay_frames: found -1"),
    ],
)
def test_numbers_that_cannot_be_played_are_refused(spoil, match, small, tmp_path):
    hand = Hand(small)
    spoil(hand)
    with pytest.raises((MatrixError, ConfigurationError), match=match):
        played(hand.read(tmp_path, small).arrays, small)


def without_rows(image):
    image.data = image.data[:0]


@pytest.mark.parametrize(
    ("image_of", "match"),
    [
        (lambda hand: hand.loop.measurements_to_modes, "reconstructor"),
        (lambda hand: hand.sensor.measurements, "of 0 measurements"),
        (lambda hand: hand.loop.modal_coefficients, "of 0 commands"),
    ],
)
def test_arrays_without_rows_are_refused(image_of, match, small, tmp_path):
    hand = Hand(small)
    without_rows(image_of(hand))
    with pytest.raises((MatrixError, ConfigurationError), match=match):
        played(hand.read(tmp_path, small).arrays, small)


def rewritten(path, extension, keyword, value):
    """Give a header of a FITS file another value; astropy itself writes only what is consistent."""
    content = path.read_bytes()
    part = content.index(f"EXTNAME = '{extension}".encode())
    place = content.rindex(b"XTENSION", 0, part)
    place = content.index(f"{keyword:8}=".encode(), place)
    card = f"{keyword:8}= {value:>20}".ljust(80).encode()
    path.write_bytes(content[:place] + card + content[place + 80 :])


@pytest.mark.parametrize("extension", ["SLOPES", "MASK", "MODAL", "CONTROL"])
def test_an_image_without_data_is_as_one_that_is_missing(extension, small, tmp_path):
    Hand(small).read(tmp_path, small)
    path = tmp_path / "hand.fits"
    with fits.open(path, memmap=False) as units:
        units[extension].data = None
        units.writeto(path, overwrite=True)
    if extension == "CONTROL":
        assert "reconstructor" not in read_telemetry(path, small).arrays
    elif extension in {"SLOPES", "MODAL"}:  # without frames, alpha may still be read
        assert read_telemetry(path, small).arrays == {}
    else:
        with pytest.raises(MatrixError, match="found no subaperture_mask"):
            read_telemetry(path, small)


def test_a_part_of_negative_size_is_refused(small, tmp_path):
    """astropy would go back by that size, and read the same part again and again."""
    Hand(small).read(tmp_path, small)
    rewritten(tmp_path / "hand.fits", "CONTROL", "NAXIS3", -5)
    with pytest.raises(MatrixError, match=r"hand\.fits"):
        read_telemetry(tmp_path / "hand.fits", small)


def played(arrays, about):
    return list(Arrays(path=Path("hand.fits"), found=arrays).messages(about))


def test_commands_of_more_frames_than_signals_without_any_number_are_refused(small, tmp_path):
    hand = Hand(small)
    hand.sensor.measurements = aotpy.Image("slopes", hand.slopes[:-1])
    hand.loop.modal_coefficients.time = None
    with pytest.raises(MatrixError, match="of 5 measurements, 0 and 0 of 6 commands"):
        hand.read(tmp_path, small)


def test_commands_of_actuators_become_modes_less_their_reference(with_strokes, tmp_path):
    hand, strokes = Hand(with_strokes), with_strokes.mirror.mode_to_actuator
    flat = RNG.normal(size=len(strokes))
    sent_um = 1e6 * hand.modal_m @ strokes.T + flat
    hand.loop.modal_coefficients = None
    hand.loop.commands = aotpy.Image("commands", sent_um, unit="um", time=hand.time)
    hand.loop.ref_commands = aotpy.Image("flat", flat, unit="um")
    night = hand.read(tmp_path, with_strokes)
    np.testing.assert_allclose(night.arrays["commands_m"], hand.modal_m, atol=1e-9)
    assert night.notes == ["commands of actuators: turned into modes by mode_to_actuator"]


def test_commands_of_other_actuators_are_refused(small, with_strokes, tmp_path):
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    hand = Hand(with_strokes)
    hand.loop.modal_coefficients = None
    other = RNG.normal(size=(N, len(small.mirror.positions_m)))
    hand.loop.commands = aotpy.Image("commands", other, unit="m", time=hand.time)
    with pytest.raises(MatrixError, match="that no mode of mode_to_actuator makes"):
        hand.read(tmp_path, with_strokes)
    hand.loop.commands = aotpy.Image("commands", other[:, 1:], unit="m", time=hand.time)
    with pytest.raises(MatrixError, match="expected modal_coefficients, or an instrument file"):
        hand.read(other_folder, with_strokes)


def test_a_time_filter_tells_gains_and_leak(small, tmp_path):
    hand = Hand(small)
    hand.filter([[0.3, 0.0]] * N_CONTROLLED, [[1.0, -0.98]] * N_CONTROLLED)
    arrays = hand.read(tmp_path, small).arrays
    np.testing.assert_array_equal(arrays["gains"], np.full(N_CONTROLLED, 0.3))
    assert arrays["leak"] == 0.98


@pytest.mark.parametrize(
    ("above", "below"), [([[0.3, 0.1]], [[1.0, -0.98]]), ([[0.3]] * 2, [[1.0, -0.98], [1.0, -1.0]])]
)
def test_another_time_filter_is_said_to_be_left_alone(above, below, small, tmp_path):
    hand = Hand(small)
    hand.filter(above, below)
    night = hand.read(tmp_path, small)
    assert "gains" not in night.arrays
    assert night.notes == ["the time filter is no integrator with one leak: gains are taken as 0.5"]
