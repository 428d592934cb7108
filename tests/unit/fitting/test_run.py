"""From files to fits: matrices and detector frames, with what the file and the instrument say."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.fit_file import fit_file, make_reference
from pyrcal.fitting.matrix import FitOptions
from pyrcal.fitting.recorded import Recorded, read_recorded
from service.errors import MatrixError
from service.instrument import load_instrument
from service.model.misregistration import Misregistration
from service.model.modes import karhunen_loeve_basis
from service.model.sensors.pyramid.description import FrameWindows
from service.model.slopes import Orientation, SlopeRecipe
from sim_rtc.telescope.diffractive import DiffractivePlant
from tests.data.tiny.make import ALPHA, HERE, STROKE_M

N_MODES = 20
ROWS, COLUMNS = (3, 21), (4, 25)
"""Where the windows of 12 pixels begin on the detector."""


@pytest.fixture(scope="module")
def instrument():
    return load_instrument(HERE / "tiny.toml")


@pytest.fixture(scope="module")
def camera(instrument):
    """The tiny bench with a detector that is read out whole, its axes those of conventions.md."""
    centres = [[row + 5.5, column + 5.5] for row in ROWS for column in COLUMNS]
    return replace(
        instrument,
        double_pass=False,
        slopes=SlopeRecipe(orientation=Orientation()),
        frames=FrameWindows(centres_px=np.array(centres)),
    )


@pytest.fixture(scope="module")
def cube(camera, tmp_path_factory):
    """A file of push-pull frames of the diffractive simulator."""
    plant = DiffractivePlant(camera, karhunen_loeve_basis(camera), rng=np.random.default_rng(1))
    optics = plant.optics(Misregistration.from_boundary(ALPHA))

    def frame(mode, stroke_m):
        command = np.zeros(optics.opd_per_command.shape[1], dtype=np.float32)
        command[mode] = stroke_m
        light = optics.light(optics.mirror_opd_m(command)).astype(np.float64)
        pixels = np.zeros((40, 44))
        for y, row in enumerate(ROWS):
            for x, column in enumerate(COLUMNS):
                pixels[row : row + 12, column : column + 12] = light[y, :, x]
        return pixels

    path = tmp_path_factory.mktemp("frames") / "frames.h5"
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = np.array(
            [
                (frame(mode, STROKE_M) - frame(mode, -STROKE_M)) / (2 * STROKE_M)
                for mode in range(N_MODES)
            ]
        )
        file["flux_frame"] = frame(0, 0.0)
    return path


def recorded(values, **changes):
    made = Recorded(
        values=values,
        modes=None,
        noise=None,
        double_pass=None,
        flux_frame=None,
        where="im.h5:/interaction_matrix",
        sha256="0" * 64,
    )
    return replace(made, **changes)


def check_alpha(report):
    found = report.fit.alpha.to_boundary()
    for name, tolerance in zip(ALPHA, (0.03, 0.03, 0.1, 0.004), strict=True):
        assert abs(found[name] - ALPHA[name]) < tolerance, (name, found[name])


def test_a_report_says_what_was_fitted_for_what(instrument):
    report = fit_file(instrument, HERE / "tiny.h5", FitOptions(modes=np.arange(N_MODES)))
    check_alpha(report)
    assert report.instrument == "tiny"
    assert report.reference.endswith("tiny.h5:/interaction_matrix")
    assert report.double_pass is True
    assert 0.0 < report.seconds < 60.0
    assert report.fit.modes.tolist() == list(range(N_MODES))


def test_detector_frames_are_cut_and_fitted(camera, cube):
    report = fit_file(camera, cube, FitOptions())
    check_alpha(report)
    assert report.fit.residual_fraction < 0.1


def test_progress_is_told(instrument):
    told = []
    options = FitOptions(modes=np.arange(10))
    fit_file(instrument, HERE / "tiny.h5", options, progress=told.append)
    assert told


def test_a_refusal_names_the_file(instrument, tmp_path):
    path = tmp_path / "im.h5"
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = np.ones((40, 224))
    with pytest.raises(MatrixError, match=f"^{path}:/interaction_matrix: .*transposed"):
        fit_file(instrument, path, FitOptions())


def test_the_measurement_knows_best_how_often_light_met_the_mirror(instrument):
    matrix = np.ones((224, 3))
    plain, notes = make_reference(recorded(matrix), instrument)
    assert plain.double_pass is True
    assert not notes
    single, notes = make_reference(recorded(matrix, double_pass=False), instrument)
    assert single.double_pass is False
    assert "instrument file says otherwise" in notes[0]


def test_modes_and_noise_of_the_file_are_used_and_told(instrument):
    modes, noise = np.array([3, 1, 2]), np.array([0.1, 0.2, 0.3])
    found, notes = make_reference(recorded(np.ones((224, 3)), modes=modes, noise=noise), instrument)
    assert found.modes is modes
    assert found.noise is noise
    assert "the 3 modes the measured file names" in notes[0]


def test_what_should_be_known_of_the_instrument_is_told(instrument):
    remarked = replace(instrument, remarks=("tiny.toml: odd",))
    assert make_reference(recorded(np.ones((224, 3))), remarked)[1] == ("tiny.toml: odd",)


def test_noise_of_frames_is_not_taken_for_noise_of_slopes(camera, cube):
    read = replace(read_recorded(cube), noise=np.ones(N_MODES))
    reference, notes = make_reference(read, camera)
    assert reference.noise is None
    assert "not used" in notes[0]


def test_frames_need_an_instrument_that_delivers_them(instrument, cube):
    with pytest.raises(MatrixError, match=r'need wfs.input = "frames"'):
        make_reference(read_recorded(cube), instrument)


def test_an_instrument_that_delivers_frames_needs_them(camera):
    with pytest.raises(MatrixError, match="expected detector frames"):
        make_reference(recorded(np.ones((224, 3))), camera)


def test_frames_need_the_mean_frame(camera, cube):
    with pytest.raises(MatrixError, match="found no flux_frame"):
        make_reference(replace(read_recorded(cube), flux_frame=None), camera)


def test_where_pupil_images_were_found_is_told(camera, cube):
    auto = replace(camera, frames=FrameWindows())
    reference, notes = make_reference(read_recorded(cube), auto)
    assert reference.matrix.shape == (224, N_MODES)
    assert "pupil_centres_px = [[8." in notes[0]
    assert not make_reference(read_recorded(cube), camera)[1]
