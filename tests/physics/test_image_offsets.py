"""Pupil images beside the pixel grid: the model and the fit against an FFT pyramid.

The reference shares no code with the model. A small bench of 12 subapertures and 40 modes; its
four images are displaced by 0.1 subaperture RMS along either axis.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.matrix import FitOptions, fit_matrix
from pyrcal.importers.files import Reported, from_arrays
from pyrcal.instruments.program import find_image_offsets
from pyrcal_studies.fft_pyramid import DisplacedPyramid
from pyrcal_studies.image_offsets import (
    SEPARATION,
    TRUTH,
    N,
    as_told,
    basis,
    bench,
    displacements,
    filmed,
    measured,
    model_of,
)
from service.estimation.reference import Reference
from service.instrument import load_instrument
from service.model.kinds import Stop
from service.model.pupil import valid_subapertures
from service.model.sensors.pyramid.description import FrameWindows
from service.model.sensors.pyramid.detector_windows import found_centres, frame_windows

RMS = 0.1
TOLERANCE = 0.01
"""Subapertures: what the fit must reach with images 0.1 subaperture off."""


@pytest.mark.parametrize("stop", list(Stop))
def test_the_model_with_displaced_images_is_the_fft_pyramid(stop):
    instrument, offsets = bench(stop), displacements(1)
    expected = measured(instrument, offsets)
    left = [
        np.linalg.norm(model_of(about).interaction_matrix(TRUTH) - expected)
        / np.linalg.norm(expected)
        for about in (as_told(instrument, offsets), instrument)
    ]
    assert left[0] < 0.01  # the reference's padding of 72 subapertures leaves 0.5 %
    assert left[1] > 0.05  # and displaced images that nobody mentions ten times as much


@pytest.mark.parametrize(
    ("stop", "told"),
    [
        (Stop.MIRROR, False),
        (Stop.TELESCOPE, True),
        pytest.param(Stop.MIRROR, True, marks=pytest.mark.long),
        pytest.param(Stop.TELESCOPE, False, marks=pytest.mark.long),
    ],
)
def test_a_fit_is_right_with_images_a_tenth_of_a_subaperture_off(stop, told):
    instrument, offsets = bench(stop), displacements(2)
    matrix = measured(instrument, offsets)
    about = as_told(instrument, offsets) if told else instrument
    fit = fit_matrix(about, Reference(matrix=matrix), FitOptions(), basis=basis())
    error = fit.alpha.vector - TRUTH.vector
    assert fit.accepted
    assert np.all(np.abs(error) < 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert np.abs(error[:2]).max() < TOLERANCE
    assert np.sqrt(np.diag(fit.covariance))[:2].max() < TOLERANCE
    assert (fit.image_offsets_px is None) is told


def test_a_pupil_beside_the_middle_of_the_grid_is_found_with_a_telescope_as_stop():
    instrument = bench(Stop.TELESCOPE)
    offsets = np.broadcast_to([0.3, -0.2], (2, 2, 2)).copy()
    fit = fit_matrix(
        instrument, Reference(matrix=measured(instrument, offsets)), FitOptions(), basis=basis()
    )
    assert fit.accepted
    assert np.all(np.abs(fit.alpha.vector - TRUTH.vector) < 3.0 * np.sqrt(np.diag(fit.covariance)))
    assert fit.image_offsets_px is not None
    assert fit.image_offsets_px.mean(axis=0) == pytest.approx([0.3, -0.2], abs=0.02)


def frame_of(instrument, offsets, unevenness, wide):
    """Return a frame of the light, four touching quadrants ``wide`` pixels across."""
    pupil = model_of(instrument).pupil
    slope = pupil.coordinates / (N / 2)
    light = 1.0 + unevenness * slope + 0.5 * unevenness * slope[:, None] ** 2
    camera = DisplacedPyramid(
        amplitude=pupil.amplitude * np.sqrt(light),
        sampling=4,
        wavelength_m=750e-9,
        n_subapertures=wide,
        image_separation_subap=float(wide),
        modulation_lambda_over_d=3.0 * wide / N,
        n_nodes=3,
        padded_subap=6 * N,
        offsets=offsets,
    )
    return camera.images(np.zeros_like(pupil.amplitude)).reshape(2 * wide, 2 * wide)


@pytest.mark.parametrize("unevenness", [0.0, 0.3])
def test_one_command_finds_the_places_of_the_images_in_a_frame_or_a_flux(tmp_path, unevenness):
    wide = 18
    instrument, errors = bench(Stop.TELESCOPE), []
    instrument = replace(instrument, wfs=replace(instrument.wfs, pupil_separation_subap=18.0))
    for seed in range(3):
        offsets = np.random.default_rng(seed).uniform(-0.3, 0.3, size=(2, 2, 2))
        frame = frame_of(instrument, offsets, unevenness, wide)
        first = (wide - N) // 2 + np.array([0, wide])
        flux = [frame[y : y + N, x : x + N] for y in first for x in first]
        for name, light in (("frame.npy", frame), ("flux.npy", np.stack(flux))):
            np.save(tmp_path / name, light)
            line = find_image_offsets(instrument, tmp_path / name)
            places = np.array(tomllib.loads(line)["image_offsets_px"])
            errors.append(places - offsets.reshape(4, 2) + offsets.mean(axis=(0, 1)))
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.abs(errors).max() < 0.03


@pytest.mark.parametrize("unevenness", [0.0, 0.3])
def test_centres_in_a_flux_frame_are_found_to_a_hundredth_of_a_pixel(unevenness):
    wide = int(SEPARATION)
    instrument = replace(bench(Stop.TELESCOPE), frames=FrameWindows())
    rough, errors = [], []
    for seed in range(3):
        offsets = np.random.default_rng(seed).uniform(-0.5, 0.5, size=(2, 2, 2))
        frame = frame_of(instrument, offsets, unevenness, wide)
        sides = np.array([0.0, wide]) + (wide - 1) / 2
        nominal = np.stack(np.meshgrid(sides, sides, indexing="ij"), axis=-1)
        centres = nominal + offsets[..., ::-1]
        rough.append(found_centres(frame, float(N)) - centres)
        errors.append(frame_windows(instrument, frame).centres_px - centres)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.abs(errors).max() < 0.03
    assert np.sqrt(np.mean(np.square(rough))) > 0.03  # which the middle of what is lit is not


def test_images_are_not_displaced_to_explain_spiders_that_the_file_does_not_mention():
    """A third of the signal is left over, most of it by four arms."""
    instrument = bench(Stop.TELESCOPE)
    mask = valid_subapertures(instrument)
    instrument = replace(instrument, wfs=replace(instrument.wfs, valid_subapertures=mask))
    arms = {"spiders_m": 0.25, "spiders_deg": (10.0, 100.0, 200.0, 290.0)}
    telescope = replace(instrument, obscuration_ratio=0.28, **arms)
    matrix = model_of(telescope).interaction_matrix(TRUTH)
    even, lit = (
        fit_matrix(instrument, Reference(matrix=matrix), FitOptions(find_light=find), basis=basis())
        for find in (False, True)
    )
    assert even.residual_fraction > 0.3
    # Shadows are uneven light, of which a smooth gain follows a part.
    assert 0.2 < lit.residual_fraction < 0.3
    for fit in (even, lit):
        assert np.all(np.abs(fit.alpha.vector - TRUTH.vector) < 3.0 * fit.sigma)
        assert np.sqrt(np.mean(fit.image_offsets_px**2)) < 0.05  # 0.11 if every slope counts


def test_an_importer_writes_the_centres_that_a_fit_finds_in_the_light(tmp_path):
    instrument, offsets = bench(Stop.TELESCOPE), displacements(3)
    frames, rest = filmed(replace(instrument, frames=FrameWindows()), offsets, every=10)
    arrays = {
        "matrix": frames,
        "light": rest,
        "positions": instrument.mirror.positions_m,
        "mode_to_actuator": basis().mode_to_actuator[:, ::10],
    }
    reported = Reported(
        diameter_m=4.0,
        stop="telescope",
        obscuration_ratio=0.2,
        wavelength_m=750e-9,
        modulation_lambda_over_d=3.0,
        pixels_per_subaperture=1,
    )
    saved = from_arrays("camera", arrays, reported).save(tmp_path)
    written = load_instrument(saved.instrument).frames.centres_px
    nominal = np.array([8.0, 25.0])  # of quadrants 17 pixels wide
    centres = np.stack(np.meshgrid(nominal, nominal, indexing="ij"), axis=-1) + offsets[..., ::-1]
    assert np.abs(written.reshape(2, 2, 2) - centres).max() < 0.02
