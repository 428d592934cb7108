"""Pupil images beside the pixel grid, seen in the flux of a status."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from check_rtc.check import measure_image_offsets
from check_rtc.examine import Examination, examine
from check_rtc.requirements import Outcome
from check_rtc.telemetry_checks import ImageOffsets
from service.instrument import load_instrument
from service.model.kinds import KarhunenLoeve
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.slopes import Orientation
from sim_rtc.telescope.detector import Detector
from sim_rtc.telescope.diffractive import DiffractivePlant
from sim_rtc.telescope.imperfections import SETS
from tests.support.night import INSTRUMENT
from tests.support.pretend import Pretend


@cache
def instrument():
    return replace(load_instrument(INSTRUMENT), modes=KarhunenLoeve(n_modes=6))


def seen(rms_px, imperfections="realistic"):
    """Return the flux of a status, and where the images truly lie, pixels."""
    about = instrument()
    plant = DiffractivePlant(
        about,
        karhunen_loeve_basis(about),
        rng=np.random.default_rng(4),
        imperfections=replace(SETS[imperfections], image_offset_rms_px=rms_px),
    )
    images = plant.optics(Misregistration(shift_x_subap=0.1)).images
    detector = Detector(
        about, images=images, valid=plant.valid, magnitude=6.0, frame_rate_hz=1000.0
    )
    return detector.flux(images), plant.image_offsets_px


@pytest.mark.parametrize("imperfections", ["ideal", "realistic"])
@pytest.mark.parametrize("rms_px", [0.05, 0.1, 0.3])
def test_images_are_found_to_a_hundredth_of_a_pixel(rms_px, imperfections):
    flux, true = seen(rms_px, imperfections)
    places = measure_image_offsets(instrument(), flux)
    error = places.measured_px - true
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert np.all(np.abs(error) < 3.0 * places.sigma_px)
    assert places.nominal_px is None


def test_places_are_those_of_the_rtcs_axes_whatever_its_orientation():
    flux, _ = seen(0.1)
    turned = replace(instrument().slopes, orientation=Orientation(swap_xy=True, flip_x=True))
    places = measure_image_offsets(replace(instrument(), slopes=turned), flux)
    np.testing.assert_allclose(
        places.measured_px, measure_image_offsets(instrument(), flux).measured_px
    )


def test_images_where_the_instrument_file_has_them_are_as_they_should_be():
    flux, true = seen(0.1)
    told = replace(instrument().wfs, image_offsets_subap=tuple(map(tuple, true + 0.05)))
    about = replace(instrument(), wfs=told)
    places = measure_image_offsets(about, flux)
    np.testing.assert_allclose(places.nominal_px, true, atol=1e-12)  # less the mean
    assert outcome(flux, about).outcome is Outcome.OK
    assert outcome(flux, instrument()).outcome is Outcome.SEEN
    assert outcome(seen(0.0)[0], instrument()).outcome is Outcome.OK


def outcome(flux, about):
    """Return the check of an RTC that reports this flux."""
    rtc = Pretend()
    rtc.twists["status"] = {"flux": flux}
    examination = Examination(
        passive=True,
        listen_s=1.0,
        only=frozenset({"images"}),
        find_images=lambda seen_flux: measure_image_offsets(about, seen_flux),
    )
    (one,) = examine(rtc.talk(), examination)
    return one


def test_what_is_needed_and_not_there_is_named():
    no_flux = outcome(None, instrument())
    assert (no_flux.outcome, "flux" in no_flux.found) == (Outcome.SKIPPED, True)
    other = outcome(np.ones((4, 5, 5), "<f4").tobytes(), instrument())
    assert (other.outcome, "(4, 12, 12)" in other.found) == (Outcome.SKIPPED, True)
    lenslets = measure_image_offsets(load_instrument("canary"), b"")
    assert not isinstance(lenslets, ImageOffsets)
