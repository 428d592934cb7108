"""Registration from nothing known, against the truth of a linear plant with its loop open."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from service.control.dither import COARSE_BAND, FINE_BAND, spread_lines, spread_modes
from service.estimation.lockin import LockIn, LockInPlan
from service.estimation.openloop import MAX_UNEXPLAINED_SHARE, WideCaptureSearch, far_starts, find
from service.model.instrument import SlopeRecipe
from service.model.interaction import InteractionModel
from service.model.kinds import Stop
from service.model.misregistration import Misregistration
from service.model.slopes import Orientation
from service.records.estimates import RefusalKind, WideCaptureEstimate, WindowRefused
from tests.support.lamps import counts_of, small
from tests.support.numerics import (
    FRAME_RATE_HZ,
    N_MODES,
    Sky,
    closed_loop,
    sines,
    small_basis,
    small_instrument,
    small_loop,
)

FAR = Misregistration(
    shift_x_subap=1.3, shift_y_subap=-1.1, rotation_rad=np.deg2rad(-5.0), magnification=1.045
)
CORNERS = [
    Misregistration.from_vector(
        np.array([1.5 * x, 1.5 * y, np.deg2rad(6.0) * turn, 1.0 + 0.05 * size])
    )
    for x, y, turn, size in [(1, 1, 1, 1), (-1, 1, -1, 1), (1, -1, -1, -1), (-1, -1, 1, -1)]
]
NOMINAL = Misregistration()


def plan(reach=COARSE_BAND, amplitude_m=50e-9):
    lines = spread_lines(FRAME_RATE_HZ, 1.0, 6)
    modes = spread_modes(reach, N_MODES, len(lines))
    return LockInPlan(
        modes=modes,
        frequencies_hz=lines[: len(modes)],
        amplitude_m=(amplitude_m,) * len(modes),
        frame_rate_hz=FRAME_RATE_HZ,
        n_frames=1000,
        first_seq=0,
    )


def window(alpha, what=None, *, late_frames=0, **sky):
    """One second of an open loop: its gain is 0."""
    what = what or plan()
    block = closed_loop(small_loop(gain=0.0), Sky(alpha=alpha, **sky), sines(what, 1000))
    if late_frames:
        block = replace(block, slopes=np.roll(block.slopes, late_frames, axis=0))
    _, (spectra,) = LockIn(plan=what).accumulate(block)
    return spectra


@cache
def model(modes, sampling):
    return InteractionModel(
        small_instrument(),
        small_basis().subset(np.array(modes)),
        pupil_sampling=sampling,
        detector_nodes=sampling,
    )


def look(spectra, *starts):
    modes = spectra.plan.modes
    search = WideCaptureSearch(
        coarse=model(modes, 1), fine=model(modes, 2), nominal=NOMINAL, starts=starts or (NOMINAL,)
    )
    return find(spectra, search)


def error(found, alpha):
    assert isinstance(found, WideCaptureEstimate), found
    return np.abs(found.estimate.alpha.vector - alpha.vector)


@pytest.mark.parametrize("alpha", [*CORNERS, FAR], ids=lambda a: str(a.to_boundary()))
def test_smooth_modes_lead_home_from_every_corner_of_the_range(alpha):
    found = look(window(alpha))
    # the model that decides is coarser than the one that made the telemetry
    assert np.all(error(found, alpha) < COARSE_BAND.floor)
    assert found.unexplained < MAX_UNEXPLAINED_SHARE / 2


def test_finer_modes_confirm_from_where_smooth_ones_lead():
    first = look(window(FAR)).estimate.alpha
    found = look(window(FAR, plan(FINE_BAND)), first)
    assert np.all(error(found, FAR) < FINE_BAND.floor)


def test_the_stated_sigma_is_the_scatter_from_window_to_window():
    found = [look(window(FAR, seed=seed), FAR).estimate for seed in range(12)]
    scatter = np.std([one.alpha.vector for one in found], axis=0, ddof=1)
    stated = np.sqrt(np.mean([np.diag(one.covariance) for one in found], axis=0))
    # of 12 samples the 99.9 % range is 0.4 to 1.7
    assert np.all((scatter / stated > 0.4) & (scatter / stated < 1.7))


def test_optical_gain_is_measured_and_does_not_move_alpha():
    weak = look(window(FAR, optical_gain=0.15))
    assert np.all(error(weak, FAR) < COARSE_BAND.floor)
    np.testing.assert_allclose(np.abs(weak.estimate.optical_gain), 0.15, rtol=0.05)


def test_a_later_start_is_taken_where_the_first_leads_nowhere():
    outside = Misregistration(shift_x_subap=2.9, shift_y_subap=2.9, rotation_rad=np.deg2rad(-19.0))
    found = look(window(CORNERS[3]), outside, NOMINAL)
    assert np.all(error(found, CORNERS[3]) < COARSE_BAND.floor)


def test_another_mirrors_response_is_refused():
    spectra = window(FAR)
    swapped = np.roll(np.arange(len(spectra.plan.modes)), 1)
    found = look(replace(spectra, slopes=spectra.slopes[swapped]))
    assert isinstance(found, WindowRefused)
    assert found.reason.code == "window.not-found"
    assert found.kind is RefusalKind.NOT_FOUND


def test_a_dither_below_the_noise_is_refused():
    found = look(window(FAR, plan(amplitude_m=2e-11), noise=0.2))
    assert isinstance(found, WindowRefused)


def test_columns_a_frame_apart_are_refused():
    found = look(window(FAR, late_frames=1))
    assert isinstance(found, WindowRefused)
    assert found.reason.values["about"] in {"not-found.misaligned", "not-found.unexplained"}


def test_without_a_start_nothing_is_found():
    modes = plan().modes
    nowhere = WideCaptureSearch(
        coarse=model(modes, 1), fine=model(modes, 2), nominal=NOMINAL, starts=()
    )
    assert isinstance(find(window(FAR), nowhere), WindowRefused)


# --- starts


def told(shift):
    """The flux as a status carries it."""
    return counts_of(small(), shift).astype("<f4").tobytes()


@pytest.mark.parametrize("shift", [(1.4, -0.9), (-0.3, 1.2)])
def test_light_tells_the_shift_where_the_mirror_is_the_stop(shift):
    first = far_starts(small(), told(shift))[0]
    assert (first.shift_x_subap, first.shift_y_subap) == pytest.approx(shift, abs=0.1)
    assert (first.rotation_rad, first.magnification) == (0.0, 1.0)


def test_the_nominal_registration_is_always_among_the_starts():
    instrument = replace(
        small(), mirror=replace(small().mirror, nominal_rotation_rad=np.deg2rad(65.08))
    )
    for flux in (None, told((1.0, 0.0))):
        assert instrument.start in far_starts(instrument, flux)


@pytest.mark.parametrize(
    "flux", [None, b"", np.zeros((4, 12, 12), "<f4").tobytes(), np.ones((4, 5, 5), "<f4").tobytes()]
)
def test_without_light_that_says_anything_the_nominal_registration_comes_first(flux):
    assert far_starts(small(), flux)[0] == small().start


def test_with_the_telescope_as_stop_the_images_say_nothing_of_the_mirror():
    instrument = small(Stop.TELESCOPE)
    assert far_starts(instrument, told((1.4, -0.9)))[0] == instrument.start


def test_light_in_axes_that_are_not_the_conventions_is_not_used():
    recipe = SlopeRecipe(orientation=Orientation(flip_x=True))
    instrument = replace(small(), slopes=recipe)
    assert far_starts(instrument, told((1.4, -0.9)))[0] == instrument.start
