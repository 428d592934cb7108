import hashlib

import h5py
import numpy as np
import pytest

from pyrcal.fitting.recorded import read_recorded
from service.archive import Archive
from service.errors import MatrixError
from service.records.operations import MeasurementRecord, MeasureState
from service.wire import Pattern, checksum

MATRIX = np.random.default_rng(1).normal(size=(8, 3))


def written(path, name="interaction_matrix", matrix=MATRIX, attributes=None, **others):
    with h5py.File(path, "w") as file:
        file[name] = matrix
        group = name.rpartition("/")[0]
        for other, values in others.items():
            file[f"{group}/{other}"] = values
        file.attrs.update(attributes or {})
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "im.h5"


def refused(path, dataset=None):
    with pytest.raises(MatrixError) as error:
        read_recorded(path, dataset)
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_a_plain_matrix_says_nothing_else(path):
    found = read_recorded(written(path))
    assert np.array_equal(found.values, MATRIX)
    assert found.modes is None
    assert found.noise is None
    assert found.double_pass is None
    assert found.flux_frame is None
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_what_our_archive_writes_is_understood(tmp_path):
    matrix = MATRIX.astype(np.float32)
    record = MeasurementRecord(
        id="im-1",
        state=MeasureState.STORED,
        pattern=Pattern.HADAMARD,
        modes=(4, 2, 9),
        amplitude_m=(1e-8,) * 3,
        n_average=5,
        n_slopes=8,
        double_pass=True,
        sha256=checksum(matrix),
    )
    archive = Archive(tmp_path)
    archive.open()
    with archive:
        archive.measured.store(record, matrix, "bench")
    found = read_recorded(tmp_path / "interaction_matrices" / "im-1.h5")
    assert np.array_equal(found.values, matrix)
    assert found.modes.tolist() == [4, 2, 9]
    assert found.double_pass is True


def test_companions_lie_in_the_same_group(path):
    written(path, "night/D", modes=[1, 2, 3], noise=[0.1, 0.2, 0.3], flux_frame=np.ones((4, 4)))
    found = read_recorded(path, "/night/D")
    assert found.modes.tolist() == [1, 2, 3]
    assert found.noise.tolist() == [0.1, 0.2, 0.3]
    assert found.flux_frame.shape == (4, 4)


def test_detector_frames_are_taken_as_they_are(path):
    assert read_recorded(written(path, matrix=np.ones((3, 5, 6)))).values.shape == (3, 5, 6)


def test_a_cube_of_the_modes_shapes_is_no_list_of_modes(path):
    assert read_recorded(written(path, modes=np.ones((3, 5, 5)))).modes is None


def test_big_endian_matrices_are_read(path):
    found = read_recorded(written(path, matrix=MATRIX.astype(">f8"))).values
    assert np.array_equal(found, MATRIX)
    assert found.dtype.isnative


def test_a_missing_matrix_lists_what_is_there(path):
    text = refused(written(path, "measured/D"))
    assert "no dataset interaction_matrix" in text
    assert "measured/D (8, 3)" in text
    assert "--dataset" in text


def test_a_vector_is_no_matrix(path):
    assert "found shape (8,)" in refused(written(path, matrix=MATRIX[:, 0]))


@pytest.mark.parametrize(
    ("modes", "said"),
    [
        ([1, 2], "expected one for each of 3"),
        ([1, 1, 2], "mode 1 more than once"),
        ([-1, 0, 1], "0-based"),
    ],
)
def test_modes_that_are_none_are_refused(path, modes, said):
    assert said in refused(written(path, modes=modes))


def test_noise_is_positive_and_one_for_each_column(path):
    assert "expected the positive 1 sigma" in refused(written(path, noise=[0.1, 0.0, 0.1]))


def test_double_pass_is_yes_or_no(path):
    assert "expected true or false" in refused(written(path, attributes={"double_pass": "both"}))


@pytest.fixture
def fits_path(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "im.fits"
    primary = fits.PrimaryHDU(MATRIX)
    primary.header["DBLPASS"] = True
    primary.writeto(path)
    return path


def test_the_only_image_of_a_fits_file_is_the_matrix(fits_path):
    found = read_recorded(fits_path)
    assert np.array_equal(found.values, MATRIX), "FITS counts axes the other way, we do not"
    assert found.double_pass is True


def test_of_several_images_the_matrix_must_be_named(fits_path):
    fits = pytest.importorskip("astropy.io.fits")
    with fits.open(fits_path, mode="append") as file:
        file.append(fits.ImageHDU(np.array([5, 6, 7]), name="MODES"))
    assert "MODES (3,)" in refused(fits_path)
    assert read_recorded(fits_path, "0").modes.tolist() == [5, 6, 7]
