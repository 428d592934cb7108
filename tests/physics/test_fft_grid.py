"""The model on the grid of an FFT, against one that pads, transforms and adds up pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.fitting.fit_file import fit
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.sensors.pyramid.description import FrameWindows
from service.model.sensors.pyramid.table import FftGrid
from tests.support.numerics import small_basis, small_instrument

POINTS, WIDTH, N = 2, 36, 12
"""Points along a subaperture, subapertures across the grid and across the pupil."""

MODES = [0, 1, 2, 5, 12, 39]
STROKE_M = 1e-9


def bench(modulation=0.0, rooftop=0.0, modulation_points=None):
    small = small_instrument()
    grid = FftGrid(
        points_per_subaperture=POINTS,
        width_subap=float(WIDTH),
        modulation_points=modulation_points,
    )
    wfs = replace(
        small.wfs,
        fft_grid=grid,
        modulation_lambda_over_d=modulation,
        rooftop_lambda_over_d=rooftop,
        pupil_separation_subap=16.0,
    )
    return replace(small, wfs=wfs)


def simulated_frames(amplitude, opds_m, wfs, n_modulation, first=0.5):
    """Frames ``(n_opds, WIDTH, WIDTH)`` of a textbook's pyramid, its tip between four points.

    Its surface is that of the highest of the four faces.
    """
    n, padded = len(amplitude), WIDTH * POINTS
    frequency = (np.arange(padded) - (padded - 1) / 2) / padded
    # The edge is 2 sqrt(2) times as long as the two raised faces reach beyond the middle.
    raised = wfs.rooftop_lambda_over_d / np.sqrt(2) / N / POINTS
    faces = np.maximum(
        np.abs(frequency[:, None] + frequency) + raised, np.abs(frequency[:, None] - frequency)
    )
    mask = np.exp(2j * np.pi * POINTS * wfs.image_separation_subap / 2 * faces)
    u = np.arange(padded)
    # Fourier sums at half integers: a phasor before the transform, its inverse after it.
    there = np.exp(-2j * np.pi * np.outer(frequency, u))
    place = (padded - n) // 2
    k = 2 * np.pi * wfs.modulation_lambda_over_d / N / POINTS
    frames = []
    for opd in opds_m:
        light = np.zeros((padded, padded))
        for t in 2 * np.pi * (np.arange(n_modulation) + first) / n_modulation:
            tilt = k * (np.cos(t) * u[:, None] + np.sin(t) * u)
            field = np.zeros((padded, padded), complex)
            phase = 2 * np.pi * opd / wfs.wavelength_m
            field[place : place + n, place : place + n] = amplitude * np.exp(1j * phase)
            focus = there @ (field * np.exp(1j * tilt)) @ there.T
            seen = there.conj().T @ (mask * focus) @ there.conj() / padded**2
            light += np.abs(seen) ** 2 / n_modulation
        frames.append(light.reshape(WIDTH, POINTS, WIDTH, POINTS).sum(axis=(1, 3)))
    return np.array(frames)


@pytest.mark.parametrize(
    ("modulation", "n_points", "rooftop", "on_it"),
    [
        (0.0, 2, 0.0, 1e-3),
        (3.0, 28, 0.0, 1e-3),
        (0.0, 2, 0.3, 1e-3),  # no sample of the grid is in the strips of the rooftop
        (0.0, 2, -1.2, 1e-3),  # one sample
        (0.0, 2, 2.0, 2e-3),  # two samples
        (3.0, 28, 1.2, 1e-3),
    ],
)
def test_a_matrix_of_an_fft_is_that_of_the_model_on_its_grid(modulation, n_points, rooftop, on_it):
    """Without the grid the model, which has no ends, is 7 and 4 % off a coarse simulation."""
    about = bench(modulation, rooftop)
    assert compare(about, n_points) < on_it
    plain = replace(about, wfs=replace(about.wfs, fft_grid=None))
    assert compare(plain, n_points, sampling=4) > 0.02


@pytest.mark.parametrize(("modulation", "n_points"), [(0.5, 4), (3.0, 20)])
def test_a_modulation_of_few_points_is_that_of_the_simulation(modulation, n_points):
    known, unknown = (bench(modulation, 0.0, points) for points in (n_points, None))
    assert compare(known, n_points, first=0.0) < 1e-3
    assert compare(unknown, n_points, first=0.0) > 5e-3


def compare(about, n_points, first=0.5, sampling=POINTS):
    """Return by how much the model's matrix differs from that of the frames."""
    model = InteractionModel(about, small_basis(), pupil_sampling=POINTS, detector_nodes=POINTS)
    maps = np.zeros((len(MODES), *model.pupil.amplitude.shape))
    maps[:, model.pupil.lit] = STROKE_M * small_basis().render(model.pupil.points)[:, MODES].T
    push, pull = (
        simulated_frames(model.pupil.amplitude, sign * maps, about.wfs, n_points, first)
        for sign in (1.0, -1.0)
    )
    middle, half = WIDTH / 2, about.wfs.image_separation_subap / 2

    def slopes(frame):
        first, second = (round(middle + side * half - N / 2) for side in (-1, 1))
        ends = [slice(start, start + N) for start in (first, second)]
        images = np.array([[frame[y, x] for x in ends] for y in ends])
        flux = images.sum(axis=(0, 1))[model.valid].mean()
        along_x, along_y = images[:, 0] - images[:, 1], images[0] - images[1]
        both = [along_x.sum(axis=0)[model.valid], along_y.sum(axis=0)[model.valid]]
        return np.concatenate(both) / flux

    expected = np.array(
        [
            (slopes(one) - slopes(other)) / (2 * STROKE_M)
            for one, other in zip(push, pull, strict=True)
        ]
    ).T
    judged = InteractionModel(
        about, small_basis(), pupil_sampling=sampling, detector_nodes=sampling
    )
    found = judged.interaction_matrix(Misregistration())[:, MODES]
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


def measure_frames(about, magnification):
    """Return the instrument with windows, and frames of its modes at a shift of 0.3 and -0.4.

    A negative magnification turns the mirror by 180 deg as well.
    """
    pupil = InteractionModel(
        about, small_basis(), pupil_sampling=POINTS, detector_nodes=POINTS
    ).pupil
    maps = np.zeros((40, *pupil.amplitude.shape))
    points = (pupil.points - [0.3, -0.4]) / magnification
    maps[:, pupil.lit] = STROKE_M * small_basis().render(points).T
    push, pull = (
        simulated_frames(pupil.amplitude, sign * maps, about.wfs, 2) for sign in (1.0, -1.0)
    )
    middle, half = (WIDTH - 1) / 2, about.wfs.image_separation_subap / 2
    centres = middle + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    windows = FrameWindows(centres_px=centres, normalised=True)
    seen = replace(about, stop=Stop.TELESCOPE, frames=windows)
    return seen, (push - pull) / (2 * STROKE_M) / push.sum(axis=(1, 2))[:, None, None]


@pytest.mark.parametrize("rotation_deg", [0.0, 180.0])
def test_frames_of_an_unmodulated_pyramid_have_a_unit_although_its_modulation_is_unknown(
    rotation_deg,
):
    """With the light of the usual 3 λ/D gains were 0.6, and no orientation was found at 180 deg."""
    about, frames = measure_frames(bench(0.0), -1.1 if rotation_deg else 1.1)
    wfs = replace(about.wfs, modulation_lambda_over_d=3.0)
    found = fit(replace(about, wfs=wfs, unknown=("wfs.modulation_lambda_over_d",)), frames)
    assert found.accepted
    error = found.alpha.vector - [0.3, -0.4, np.deg2rad(rotation_deg), 1.1]
    error[2] = np.angle(np.exp(1j * error[2]))
    assert np.all(np.abs(error) < [0.002, 0.002, np.deg2rad(0.02), 0.002])
    assert np.median(found.gains) == pytest.approx(1.0, abs=0.02)


def frames_of_rooftop(rooftop):
    """Return an instrument with an unknown rooftop, and the frames of one, at a known α."""
    about, frames = measure_frames(bench(0.0, rooftop), 1.02)
    return replace(about, wfs=replace(about.wfs, rooftop_lambda_over_d=0.0)), frames


@pytest.mark.parametrize("rooftop", [0.0, 0.6])
def test_a_rooftop_is_found_where_the_file_calls_it_unknown(rooftop):
    about, frames = frames_of_rooftop(rooftop)
    found = fit(replace(about, unknown=("wfs.rooftop_lambda_over_d",)), frames)
    assert found.accepted
    assert np.all(np.abs(found.alpha.vector - [0.3, -0.4, 0.0, 1.02]) < 3.0 * found.sigma)
    assert found.residual_fraction < 0.005
    (one,) = (one for one in found.optics if one.key == "rooftop_lambda_over_d")
    # a flip of one axis is no rotation: it mirrors the edge
    mirrored = found.orientation.flip_x != found.orientation.flip_y
    assert one.found == pytest.approx(-rooftop if mirrored else rooftop, abs=3.0 * one.found_sigma)
    assert found.corrections["wfs.rooftop_lambda_over_d"] == pytest.approx(one.found, abs=1e-3)


def test_a_tip_that_is_none_is_named():
    about, frames = frames_of_rooftop(0.6)
    found = fit(about, frames)
    (named,) = (one for one in found.alternatives if "rooftop" in one.key)
    assert named.preferred
    assert found.corrections == {"wfs.rooftop_lambda_over_d": "unknown"}
