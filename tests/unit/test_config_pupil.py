"""Pupils of instrument files: maps and spiders, and the one line that says what is wrong."""

import h5py
import numpy as np
import pytest
from astropy.io import fits

from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from service.model.pupil import instrument_pupil, lit_subapertures
from sim_rtc.telescope.diffractive import centred_pupil

ABOUT = '[instrument]\nname = "bench"\ndiameter_m = 8.0\nstop = "telescope"\n'
REST = """
[wfs]
kind = "pyramid"
n_subapertures = 20
pupil_separation_subap = 24
wavelength_m = 750e-9
modulation_lambda_over_d = 3.0

[mirror]
layout = "grid"
n_across = 11
pitch_m = 0.8
diameter_m = 8.8

[modes]
n_modes = 50
"""


def ring(n=160, hole=0.25):
    u = (np.arange(n) - (n - 1) / 2) * 2 / n
    radius = np.hypot(u, u[:, None])
    return ((radius <= 1.0) & (radius >= hole)).astype(float)


@pytest.fixture
def bench(tmp_path):
    def _bench(keys="", lit=None):
        with h5py.File(tmp_path / "pupil.h5", "w") as file:
            file["lit"] = ring() if lit is None else lit
        path = tmp_path / "bench.toml"
        path.write_text(ABOUT + keys + REST, encoding="utf-8")
        return load_instrument(path)

    return _bench


MAP = 'pupil = "pupil.h5:/lit"\n'


def test_a_ring_as_a_map_is_the_ring_but_for_its_points(bench):
    drawn, mapped = bench("obscuration_ratio = 0.25\n"), bench(MAP)
    assert mapped.pupil.pitch_m == pytest.approx(8.0 / 160)
    assert mapped.collecting_area_m2 == pytest.approx(drawn.collecting_area_m2, rel=2e-3)
    both = [instrument_pupil(instrument, 3).amplitude for instrument in (drawn, mapped)]
    assert np.abs(both[0] - both[1]).max() < 0.2
    assert both[1].sum() == pytest.approx(both[0].sum(), rel=2e-3)
    assert (lit_subapertures(drawn) == lit_subapertures(mapped)).all()


@pytest.mark.parametrize("name", ["pupil.fits", "pupil.npy"])
def test_a_map_may_be_a_fits_image_or_a_numpy_file(bench, tmp_path, name):
    if name.endswith("npy"):
        np.save(tmp_path / name, ring().astype(np.uint8))
    else:
        fits.writeto(tmp_path / name, ring().astype(">f4"))
    assert (bench(f'pupil = "{name}"\n').pupil.lit == ring()).all()


def test_a_map_keeps_its_axes(bench):
    """[y, x]: dark at low rows is dark at low y, in the model and in the simulator's own pupil."""
    lit = ring()
    lit[:60, 80:] = 0.0
    instrument = bench(MAP, lit)
    for pupil in (instrument_pupil(instrument, 2), centred_pupil(instrument, 2)):
        n = len(pupil.amplitude)
        low_y_high_x = pupil.amplitude[: n // 4, 3 * n // 5 :]
        assert low_y_high_x.max() < 1e-9
        assert pupil.amplitude[3 * n // 4 :, 3 * n // 5 :].max() > 0.99
        area = pupil.amplitude.sum() * (instrument.subaperture_m / pupil.sampling) ** 2
        assert area == pytest.approx(instrument.collecting_area_m2, rel=5e-3)


def test_an_arm_lies_in_its_direction_and_hides_its_width(bench):
    arms = "obscuration_ratio = 0.2\nspiders_m = 0.4\nspiders_deg = [90.0, 200.0]\n"
    instrument, open_ = bench(arms), bench("obscuration_ratio = 0.2\n")
    hidden = open_.collecting_area_m2 - instrument.collecting_area_m2
    assert hidden == pytest.approx(2 * 0.4 * 3.2)
    for drawn in (instrument_pupil, centred_pupil):
        pupil, plain = drawn(instrument, 4), drawn(open_, 4)
        lost = (plain.amplitude - pupil.amplitude).sum() * (0.4 / 4) ** 2
        assert lost == pytest.approx(hidden, rel=0.01)
        u = pupil.coordinates
        x, y = np.meshgrid(u, u)
        up, down = (np.abs(x) < 0.4) & (y > 3.0) & (y < 8.0), (np.abs(x) < 0.4) & (y < -3.0)
        assert pupil.amplitude[up].max() < 1e-9
        assert pupil.amplitude[down & (y > -8.0)].min() > 0.99


def test_what_has_neither_has_the_digest_that_it_has_always_had(bench):
    """Counted before there were maps and arms."""
    assert instrument_sha256(load_instrument("flao-lbt")) == FLAO
    digests = {instrument_sha256(bench(keys)) for keys in ("", MAP, ARMS)}
    assert len(digests) == 3


FLAO = "e889ab451b0994e260c9ad7b9989786ecf7da12697f57f43031e3ec1787b2648"
ARMS = "spiders_m = 0.4\nspiders_deg = [90.0]\n"


@pytest.mark.parametrize(
    ("keys", "lit", "expected"),
    [
        (MAP, np.ones((2, 3, 4)), "instrument.pupil: found shape (2, 3, 4), expected (ny, nx)"),
        (MAP, 2 * ring(), "found values that are not 0 to 1"),
        (MAP, np.full((160, 160), np.nan), "found values that are not 0 to 1"),
        (MAP, np.zeros((160, 160)), "found no lit point, expected a pupil of 8 m"),
        (MAP + "pupil_pitch_m = 50.0\n", ring(), "pupil_pitch_m: found 50 m between points"),
        (MAP + "pupil_pitch_m = 0.03\n", ring(), "found light over 4.8 m along y, expected about"),
        (MAP, np.pad(ring(140), ((0, 20), (10, 10))), "m beside the middle of the array along y"),
        (MAP, ring(12), "pupil_pitch_m: found 0.667 m between points, expected at most a suba"),
        (MAP + "obscuration_ratio = 0.1\n", ring(), "obscuration_ratio: has no meaning beside"),
        (MAP + ARMS, ring(), "spiders_m: has no meaning beside instrument.pupil"),
        ("pupil_pitch_m = 0.05\n", ring(), "has no meaning without instrument.pupil"),
        (
            "spiders_m = 0.4\n",
            ring(),
            "instrument.spiders_deg: missing beside instrument.spiders_m",
        ),
        ("spiders_deg = [3.0]\n", ring(), "instrument.spiders_m: missing beside"),
        ('pupil = "pupil.h5"\n', ring(), "expected path:/dataset of an HDF5 file, path.fits:EXTN"),
        ('pupil = "none.npy"\n', ring(), "none.npy"),
    ],
)
def test_a_pupil_that_cannot_be_is_refused_in_one_line(bench, keys, lit, expected):
    with pytest.raises(ConfigurationError) as refused:
        bench(keys, lit)
    assert expected in str(refused.value)
    assert "\n" not in str(refused.value)
