import gzip
import sys

import h5py
import numpy as np
import pytest

from pyrcal.fitting.recorded import check_sealed
from service.errors import MatrixError
from service.files import container
from service.files.container import opened

VALUES = np.arange(6.0).reshape(2, 3)


@pytest.fixture
def hdf5(tmp_path):
    path = tmp_path / "some.h5"
    with h5py.File(path, "w") as file:
        file["measured/D"] = VALUES
        file["big"] = VALUES.astype(">f4")
        file["name"] = "not a number"
        file.attrs["double_pass"] = True
    return path


def numbers(path, name):
    with opened(path) as file:
        return file.find(name).numbers()


def refused(path, name="x"):
    with pytest.raises(MatrixError) as error:
        numbers(path, name)
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    return text


def test_an_array_is_found_with_or_without_its_first_slash(hdf5):
    assert np.array_equal(numbers(hdf5, "/measured/D"), VALUES)
    assert np.array_equal(numbers(hdf5, "measured/D"), VALUES)


def test_big_endian_numbers_come_out_native(hdf5):
    found = numbers(hdf5, "big")
    assert found.dtype == np.float64
    assert found.dtype.isnative
    assert np.array_equal(found, VALUES)


def test_what_is_in_a_file_is_listed_with_its_shape(hdf5):
    with opened(hdf5) as file:
        assert "measured/D (2, 3)" in file.listing()
        assert file.find("interaction_matrix") is None
        assert file.find("MEASURED/D") is None, "HDF5 tells capitals apart"
        assert file.facts["double_pass"]


def test_a_link_is_followed(hdf5):
    with h5py.File(hdf5, "a") as file:
        file["interaction_matrix"] = h5py.SoftLink("/measured/D")
    assert np.array_equal(numbers(hdf5, "interaction_matrix"), VALUES)


def test_text_is_no_matrix(hdf5):
    assert "expected real numbers" in refused(hdf5, "name")


def test_an_array_too_large_for_memory_is_not_read(hdf5, monkeypatch):
    monkeypatch.setattr(container, "MAX_BYTES", 40)
    assert "found shape (2, 3)" in refused(hdf5, "big")


def test_a_missing_file_is_said(tmp_path):
    assert "No such file" in refused(tmp_path / "none.h5")


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (b"", "an empty file"),
        (b"shift,rotation\n", "text that begins 'shift,rotation\\n'"),
        ("µ".encode() + b" of a table", "text that begins"),
        (b"PK\x03\x04\x14\x00", "a zip archive, as np.savez writes"),
        (b"\x80\x04\x95", "objects that Python pickled"),
        (b"\x1bLua\x00\xff", "a file that begins with the bytes 1b 4c 75 61 00 ff"),
    ],
)
def test_another_kind_of_file_is_named(tmp_path, content, kind):
    path = tmp_path / "matrix.h5"
    path.write_bytes(content)
    text = refused(path)
    assert kind in text
    _, _, advice = text.partition("expected HDF5, FITS, NumPy or MATLAB; ")
    assert advice
    assert "\n" not in text


def test_the_one_array_of_a_numpy_file_is_the_matrix(tmp_path):
    path = tmp_path / "matrix.npy"
    np.save(path, VALUES.astype(">f4"))
    assert np.array_equal(numbers(path, "interaction_matrix"), VALUES)


@pytest.mark.parametrize("n_bytes", [9, 100, -4])
def test_a_truncated_numpy_file_is_damaged(tmp_path, n_bytes):
    path = tmp_path / "matrix.npy"
    np.save(path, VALUES)
    path.write_bytes(path.read_bytes()[:n_bytes])
    assert "damaged NumPy file" in refused(path)


def test_a_numpy_file_of_anything_pickled_is_not_opened(tmp_path):
    path = tmp_path / "matrix.npy"
    np.save(path, np.array([{"a": 1}], dtype=object))
    assert "damaged NumPy file" in refused(path)


def test_a_truncated_hdf5_file_is_damaged(hdf5, tmp_path):
    path = tmp_path / "half.h5"
    path.write_bytes(hdf5.read_bytes()[: hdf5.stat().st_size // 2])
    assert "damaged" in refused(path)


@pytest.fixture
def fits_file(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "some.fits"
    fits.HDUList(
        [
            fits.PrimaryHDU(VALUES.astype(">f4")),
            fits.ImageHDU(np.array([3, 4, 5], dtype=np.int16), name="MODES"),
            fits.ImageHDU(VALUES + 1.0),
            fits.CompImageHDU(np.ones((20, 30), dtype=np.float32), name="packed"),
        ]
    ).writeto(path)
    with fits.open(path, mode="update") as file:
        file[0].header["DBLPASS"] = True
    return path


def test_fits_images_are_found_by_name_in_any_case_or_by_number(fits_file):
    assert np.array_equal(numbers(fits_file, "0"), VALUES)
    assert np.array_equal(numbers(fits_file, "modes"), [3.0, 4.0, 5.0])
    assert np.array_equal(numbers(fits_file, "2"), VALUES + 1.0)
    assert numbers(fits_file, "PACKED").shape == (20, 30)
    with opened(fits_file) as file:
        assert file.facts["dblpass"] is True


def test_a_compressed_fits_file_is_read_too(fits_file, tmp_path):
    path = tmp_path / "some.fits.gz"
    path.write_bytes(gzip.compress(fits_file.read_bytes()))
    assert np.array_equal(numbers(path, "0"), VALUES)


def test_a_truncated_fits_file_is_damaged(fits_file, tmp_path):
    path = tmp_path / "half.fits"
    path.write_bytes(fits_file.read_bytes()[:2900])
    assert "damaged" in refused(path, "0")


def test_without_astropy_it_says_what_to_install(fits_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy.io", None)
    assert "pip install astropy" in refused(fits_file, "0")


# --- files made to deceive


def test_a_link_to_itself_is_named(tmp_path):
    path = tmp_path / "loop.h5"
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = h5py.SoftLink("/interaction_matrix")
        file["to"] = h5py.SoftLink("/fro")
        file["fro"] = h5py.SoftLink("/to")
    for name in ("interaction_matrix", "to"):
        assert f"/{name}: a link that leads nowhere" in refused(path, name)


@pytest.mark.parametrize("kind", ["never written", "compressed", "one chunk"])
def test_a_small_file_that_claims_a_large_array_is_refused_before_it_is_read(tmp_path, kind):
    path = tmp_path / "claim.h5"
    with h5py.File(path, "w") as file:
        if kind == "never written":
            file.create_dataset("D", (22_000, 24_000), "f8", chunks=(22, 24_000))
        elif kind == "compressed":
            made = file.create_dataset(
                "D", (40_000, 1_000), "f8", chunks=(40_000, 100), compression=9
            )
            made[:, :100] = 0.0
        else:
            made = file.create_dataset(
                "D", (2, 3), "f8", chunks=(20_000, 20_000), maxshape=(None, None), compression=1
            )
    assert path.stat().st_size < 100_000
    text = refused(path, "D")
    assert "GB in memory" in text or "MB in memory" in text


def test_a_fits_file_that_claims_more_than_it_holds_is_refused(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    path = tmp_path / "claim.fits"
    fits.writeto(path, np.zeros((10, 10), np.float32))
    content = path.read_bytes()
    for axis in (1, 2):
        old = f"NAXIS{axis}  =                   10".encode()
        content = content.replace(old, f"NAXIS{axis}  =                22000".encode())
    packed = tmp_path / "claim.fits.gz"
    packed.write_bytes(gzip.compress(content))
    path.write_bytes(content)
    for claim in (path, packed):
        with pytest.raises(MatrixError, match=r"damaged|bytes in the file"), opened(claim) as file:
            file.find("0").numbers()


def test_compressed_measurements_are_read_as_before(tmp_path):
    path = tmp_path / "real.h5"
    values = np.random.default_rng(1).normal(size=(300, 400))
    values[:, 100:] = 0.0
    with h5py.File(path, "w") as file:
        file.create_dataset("D", data=values, chunks=True, compression=9, shuffle=True)
    assert np.array_equal(numbers(path, "D"), values)


SECRET = "/srv/secret.h5"


def made_to_reach_out(file, kind):
    if kind == "external link":
        file["deep/inside"] = h5py.ExternalLink(SECRET, "/D")
    elif kind == "data outside":
        file.create_dataset("deep/inside", (2, 3), "f8", external=[("/etc/hostname", 0, 48)])
    elif kind == "virtual":
        layout = h5py.VirtualLayout((2, 3), "f8")
        layout[:] = h5py.VirtualSource(SECRET, "D", (2, 3))
        file.create_virtual_dataset("deep/inside", layout)


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("external link", f"a link to another file, {SECRET}"),
        ("data outside", "data outside, in /etc/hostname"),
        ("virtual", f"a virtual dataset of other files, {SECRET}"),
    ],
)
def test_a_file_that_reaches_beyond_itself_is_named(tmp_path, kind, said):
    path = tmp_path / "reaching.h5"
    with h5py.File(path, "w") as file:
        file["D"] = VALUES
        made_to_reach_out(file, kind)
    with pytest.raises(MatrixError) as error:
        check_sealed(path)
    assert "/deep/inside: found " + said in str(error.value)
    assert "expected all data in the file itself" in str(error.value)


def test_links_within_a_file_and_groups_that_hold_themselves_reach_nowhere(tmp_path):
    path = tmp_path / "sealed.h5"
    with h5py.File(path, "w") as file:
        file["measured/D"] = VALUES
        file["again"] = h5py.SoftLink("/measured/D")
        file["measured/up"] = file["/"]
        file["self"] = h5py.SoftLink("/self")
    check_sealed(path)


def test_what_is_no_hdf5_file_has_no_links(tmp_path):
    path = tmp_path / "some.fits"
    path.write_bytes(b"SIMPLE  = nothing more")
    check_sealed(path)
