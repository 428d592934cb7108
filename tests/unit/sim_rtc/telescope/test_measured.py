import os
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from pyrcal.__main__ import main
from service.errors import ConfigurationError
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import analytic_basis
from service.model.sensors.pyramid.description import FrameWindows
from service.model.sensors.registry import kind_of
from service.model.sensors.sensor import Fineness
from service.model.slopes import Orientation
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from sim_rtc.telescope.measured import MeasuredPlant, read_measured_matrix, sky_diameter

ALPHA = Misregistration(shift_x_subap=0.1, rotation_rad=0.02, magnification=1.01)
TURNED = Orientation(swap_xy=True, flip_y=True, sign_x=-1)


@pytest.fixture(scope="module")
def bench(small_instrument):
    """An instrument whose RTC has axes and an order of its own."""
    recipe = replace(small_instrument.slopes, order=SlopeOrder.YX, orientation=TURNED)
    return replace(small_instrument, slopes=recipe)


@pytest.fixture(scope="module")
def modelled(bench, small_basis):
    model = RtcInteractionModel(bench, small_basis, pupil_sampling=4, detector_nodes=3)
    return model.interaction_matrix(ALPHA).astype(np.float64)


@pytest.fixture(scope="module")
def measured(modelled):
    """A response that the model explains to 20 %."""
    rng = np.random.default_rng(3)
    return modelled * (1.0 + 0.2 * rng.standard_normal(modelled.shape))


@pytest.fixture
def written(tmp_path):
    def write(matrix, name="matrix.h5", **beside):
        path = tmp_path / name
        with h5py.File(path, "w") as file:
            file["interaction_matrix"] = matrix
            for key, value in beside.items():
                if np.ndim(value):
                    file[key] = value
                else:
                    file.attrs[key] = value
        return path

    return write


def plant_of(path, instrument, basis, **more):
    read = read_measured_matrix(path, instrument, basis)
    return MeasuredPlant(instrument, basis, read, start=ALPHA, **more)


def response(plant, alpha=ALPHA):
    optics = plant.optics(alpha)
    return optics, optics.responses[0][1].matrix.astype(np.float64)


def test_a_command_answers_as_measured(written, measured, bench, small_basis):
    optics, _ = response(plant_of(written(measured), bench, small_basis))
    error = np.linalg.norm(optics.slopes_per_command - measured) / np.linalg.norm(measured)
    assert error < 1e-6  # float32


def test_turbulence_of_the_modes_shapes_is_seen_as_measured(written, measured, bench, small_basis):
    optics, seen = response(plant_of(written(measured), bench, small_basis))
    slopes = seen @ optics.opd_per_command
    assert np.linalg.norm(slopes - measured) / np.linalg.norm(measured) < 1e-3


def test_turbulence_beyond_the_modes_is_seen_as_the_model_says(
    written, measured, modelled, bench, small_basis
):
    """With the model's own matrix the whole response is the model's, in the RTC's order."""
    _, seen = response(plant_of(written(modelled), bench, small_basis))
    plant = plant_of(written(measured), bench, small_basis)
    optics, as_measured = response(plant)
    weights = plant.weights
    phase = np.random.default_rng(1).standard_normal((len(weights), 5))
    phase -= weights @ phase
    modes = optics.opd_per_command.astype(np.float64)
    modes -= weights @ modes  # nor does a sensor see piston
    content = np.linalg.lstsq(
        modes * np.sqrt(weights)[:, None], phase * np.sqrt(weights)[:, None], rcond=None
    )[0]
    beyond = phase - modes @ content
    of_model = plant.sort_rows(
        kind_of(bench).sensor(bench, plant._pupil, Fineness()).at((0.1, 0.0)).jacobian()
    )
    expected = of_model @ beyond
    scale = np.abs(expected).max()
    np.testing.assert_allclose(as_measured @ beyond, expected, rtol=0, atol=1e-3 * scale)
    np.testing.assert_allclose(seen @ phase, of_model @ phase, rtol=0, atol=0.02 * scale)


def test_without_an_orientation_only_the_modes_are_seen(written, measured, bench, small_basis):
    open_ = replace(bench, slopes=replace(bench.slopes, orientation=None))
    plant = plant_of(written(measured), open_, small_basis)
    assert not plant.knows_orientation
    _, seen = response(plant)
    assert np.linalg.matrix_rank(seen, tol=1e-4 * np.linalg.norm(seen)) == measured.shape[1]


def test_a_movement_changes_the_matrix_as_the_model_does(written, measured, bench, small_basis):
    plant = plant_of(written(measured), bench, small_basis)
    moved = Misregistration.from_vector(ALPHA.vector + np.array([0.2, -0.1, 0.01, 0.0]))
    model = RtcInteractionModel(bench, small_basis, pupil_sampling=4, detector_nodes=3)
    expected = model.interaction_matrix(moved) - model.interaction_matrix(ALPHA)
    found = plant.optics(moved).slopes_per_command - measured
    assert np.linalg.norm(found - expected) / np.linalg.norm(expected) < 1e-3


def test_columns_of_actuators_become_modes_by_their_strokes(written, bench, small_basis):
    zonal = analytic_basis(replace(bench, mirror=replace(bench.mirror, basis="zonal")))
    pokes = RtcInteractionModel(bench, zonal).interaction_matrix(ALPHA).astype(np.float64)
    read = read_measured_matrix(written(pokes), bench, small_basis)
    np.testing.assert_allclose(read.matrix, pokes @ small_basis.mode_to_actuator)
    assert len(read.notes) == 1


def test_columns_stand_where_the_file_says(written, measured, bench, small_basis):
    order = np.random.default_rng(2).permutation(measured.shape[1])
    read = read_measured_matrix(written(measured[:, order], modes=order), bench, small_basis)
    np.testing.assert_array_equal(read.matrix, measured)


def test_a_matrix_of_two_passes_is_halved(written, measured, bench, small_basis):
    read = read_measured_matrix(written(measured, double_pass=True), bench, small_basis)
    np.testing.assert_allclose(read.matrix, measured / 2)


def test_unknown_strokes_take_their_size_from_the_model(written, modelled, bench, small_basis):
    unknown = replace(bench, mirror=replace(bench.mirror, stroke_known=False))
    nominal = RtcInteractionModel(bench, small_basis).interaction_matrix(bench.start)
    for unit in (1e-9, 3.0):
        read = read_measured_matrix(written(unit * modelled), unknown, small_basis)
        ratio = np.linalg.norm(nominal, axis=0) / np.linalg.norm(read.matrix, axis=0)
        assert np.median(ratio) == pytest.approx(1.0, rel=1e-6)
        np.testing.assert_allclose(read.matrix / modelled, read.matrix[0, 0] / modelled[0, 0])


def test_known_strokes_in_another_unit_are_noted(written, modelled, bench, small_basis):
    assert not read_measured_matrix(written(modelled), bench, small_basis).notes
    assert len(read_measured_matrix(written(1e-9 * modelled), bench, small_basis).notes) == 1


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: d[:-2], ("156 slopes", "158")),
        (lambda d: d.T, ("40 slopes", "transposed")),
        (lambda d: np.where(np.arange(d.size).reshape(d.shape) == 85, np.nan, d), ("slope 2",)),
        (lambda d: np.zeros_like(d), ("zeros",)),
        (lambda d: d[:, :-1], ("39 columns", "40", "actuators")),
        (lambda d: d[:, :, None], ("wfs.input",)),
    ],
    ids=["slopes", "transposed", "nan", "zeros", "columns", "frames"],
)
def test_what_is_no_matrix_of_this_instrument_is_refused(
    written, measured, bench, small_basis, spoil, words
):
    n_slopes = len(measured)
    words = tuple(w.replace("158", str(n_slopes)).replace("156", str(n_slopes - 2)) for w in words)
    with pytest.raises(ConfigurationError, match="--matrix") as refused:
        read_measured_matrix(written(spoil(measured)), bench, small_basis)
    assert all(word in str(refused.value) for word in words)


def test_a_file_without_the_array_is_refused_with_what_it_holds(tmp_path, bench, small_basis):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["response"] = np.ones((3, 3))
    with pytest.raises(ConfigurationError, match="response"):
        read_measured_matrix(path, bench, small_basis)
    with pytest.raises(ConfigurationError, match="nowhere"):
        read_measured_matrix(tmp_path / "nowhere.h5", bench, small_basis)


def test_a_bench_stands_for_a_telescope(bench):
    assert sky_diameter(bench) == bench.diameter_m
    assert sky_diameter(replace(bench, diameter_m=0.04)) == 8.0


def refusal(capsys, *given):
    with pytest.raises(SystemExit) as ended:
        parse_options(list(given))
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("given", "option"),
    [
        ([], "--matrix"),
        (["--matrix", "m.h5", "--unevenness", "0.1"], "unevenness"),
        (["--matrix", "m.h5", "--imperfections", "realistic"], "realistic"),
        (["--matrix", "m.h5", "--far"], "--far"),
        (["--matrix", "m.h5", "--dead-actuators", "3"], "--dead-actuators"),
        (["--matrix", "m.h5", "--jump", "5:0.1,0,0,0"], "--jump"),
        (["--matrix", "m.h5", "--drift", "0.1,0,0,0"], "--drift"),
    ],
)
def test_options_that_a_measured_plant_cannot_follow_are_refused(capsys, given, option):
    assert option in refusal(capsys, "--plant", "measured", *given)


@pytest.mark.parametrize("name", ["--matrix=m.h5", "--own-matrix=model", "--sky-diameter=8"])
def test_options_of_a_measured_plant_are_refused_without_one(capsys, name):
    assert "--plant measured" in refusal(capsys, name)


def test_a_measured_matrix_may_move_from_a_known_registration():
    words = ["--plant=measured", "--matrix=m.h5", "--alpha=0,0,0,1", "--jump=5:0.1,0,0,0"]
    assert parse_options(words).jumps


def telescope_of(path, bench, *more):
    words = ["--plant", "measured", "--matrix", str(path), "--seed", "4", "--n-controlled", "20"]
    return build_telescope(parse_options([*words, *more]), bench)


def test_the_rtc_begins_with_the_inverse_of_what_was_measured(written, measured, bench):
    telescope = telescope_of(written(measured), bench)
    own = telescope.reconstructor.matrix @ measured[:, :20]
    np.testing.assert_allclose(own, np.eye(20), atol=1e-4)
    assert telescope.reconstructor.manifest.alpha is None
    assert telescope.detector.flux(telescope.optics.start().images) is None


def test_the_rtc_may_begin_with_the_inverse_of_the_model(written, measured, bench):
    telescope = telescope_of(written(measured), bench, "--own-matrix", "model")
    own = telescope.reconstructor.matrix @ measured[:, :20]
    assert 0.5 < np.median(np.diag(own)) < 1.5
    assert telescope.reconstructor.manifest.alpha is not None
    open_ = replace(bench, slopes=replace(bench.slopes, orientation=None))
    with pytest.raises(ConfigurationError, match=r"slopes\.orientation"):
        telescope_of(written(measured), open_, "--own-matrix", "model")


def test_the_loop_closes_on_a_measured_matrix(written, measured, bench):
    telescope = telescope_of(written(measured), bench, "--mag", "3")
    computer = telescope.computer(iter(telescope.feed.blocks()))
    batches = [computer.next_batch() for _ in range(60)]
    modes = batches[-1].optics.opd_per_command

    def rms(opd_m):
        return np.sqrt(telescope.weights @ (opd_m - telescope.weights @ opd_m) ** 2)

    last = batches[-30:]
    incoming = np.mean([rms(batch.phase_m) for batch in last])
    left = np.mean([rms(batch.phase_m + modes @ batch.commands_m[0]) for batch in last])
    assert left < 0.5 * incoming
    assert not any(batch.n_clipped for batch in batches)


def test_detector_frames_become_slopes_as_a_fit_makes_them(written, bench, small_basis):
    centres = np.array([[8.0, 8.5], [8.2, 28.5], [28.0, 8.3], [28.0, 28.5]])
    recipe = replace(bench.slopes, order=SlopeOrder.XY)
    of_frames = replace(
        bench,
        slopes=recipe,
        frames=FrameWindows(pixels_per_subaperture=1, centres_px=centres),
    )
    rng = np.random.default_rng(1)
    frames, light = rng.standard_normal((40, 40, 40)), 5.0 + rng.random((40, 40))
    slopes = kind_of(of_frames).signals_of_frames(of_frames, frames, light)
    path = written(frames, flux_frame=light)
    np.testing.assert_array_equal(read_measured_matrix(path, of_frames, small_basis).matrix, slopes)
    with pytest.raises(ConfigurationError, match="flux_frame"):
        read_measured_matrix(written(frames), of_frames, small_basis)
    with pytest.raises(ConfigurationError, match="frames"):
        read_measured_matrix(written(slopes), of_frames, small_basis)


BENCHES = Path(os.environ.get("PYRCAL_BENCH_DATA", "../shared/data"))


@pytest.mark.long
@pytest.mark.skipif(not (BENCHES / "ao188").is_dir(), reason="the measured data are not here")
def test_a_loop_closes_on_the_measured_matrix_of_ao188(tmp_path):
    """188 actuators as camera frames, strokes unknown: the import is taken as it is."""
    command = ["import", "cacao", str(BENCHES / "ao188"), "--diameter-m", "7.92"]
    assert main([*command, "--output", str(tmp_path)]) == 0
    plant = ["--plant", "measured", "--matrix", str(tmp_path / "matrix.h5"), "--seed", "1"]
    telescope = build_telescope(
        parse_options([*plant, "--seeing", "0.6"]), load_instrument(tmp_path / "instrument.toml")
    )
    assert telescope.plant.measured.matrix.shape[1] == 94
    computer = telescope.computer(iter(telescope.feed.blocks()))
    batches = [computer.next_batch() for _ in range(80)]
    modes = batches[-1].optics.opd_per_command
    weights = telescope.weights

    def rms(opd_m):
        return np.sqrt(weights @ (opd_m - weights @ opd_m) ** 2)

    last = batches[-40:]
    incoming = np.mean([rms(batch.phase_m) for batch in last])
    left = np.mean([rms(batch.phase_m + modes @ batch.commands_m[0]) for batch in last])
    assert left < 0.6 * incoming
