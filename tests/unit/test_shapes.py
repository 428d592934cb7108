"""A shape from a file: what the file says, what an option says, and what is refused."""

import argparse
import json

import h5py
import numpy as np
import pytest

from pyrcal.shapes import read_shape
from service.errors import ConfigurationError

fits = pytest.importorskip("astropy.io.fits")


def options(path, **given):
    return argparse.Namespace(file=path, **({"kind": None, "frame": None, "unit": None} | given))


def test_zernike_coefficients_in_a_fits_file_have_their_unit(tmp_path):
    path = tmp_path / "ncpa.fits"
    vector = fits.PrimaryHDU(np.array([0.0, 0.0, 3.0, 60.0], dtype=">f8"))
    vector.header["BUNIT"] = "nanometer"
    vector.writeto(path)
    assert read_shape(options(path, kind="zernike", frame="instrument")) == {
        "kind": "zernike",
        "frame": "instrument",
        "unit": "nm",
        "values": [0.0, 0.0, 3.0, 60.0],
        "source": "ncpa.fits",
    }


def table_of(path, **columns):
    unit = {"nanometers": "nm"}
    fits.BinTableHDU.from_columns(
        [
            fits.Column(
                name=name, format="J" if name == "noll" else "D", array=values, unit=unit.get(name)
            )
            for name, values in columns.items()
        ]
    ).writeto(path)
    return path


def test_a_fits_table_has_coefficients_by_their_numbers(tmp_path):
    path = table_of(tmp_path / "table.fits", noll=[6, 4], nanometers=[60.0, -5.0])
    found = read_shape(options(path, frame="instrument"))
    assert (found["kind"], found["unit"]) == ("zernike", "nm")
    assert found["values"] == [0.0, 0.0, 0.0, -5.0, 0.0, 60.0]
    with pytest.raises(ConfigurationError, match="found --kind modes, expected zernike"):
        read_shape(options(path, kind="modes", frame="mirror"))


def test_a_fits_table_without_numbers_has_coefficients_in_their_order(tmp_path):
    path = table_of(tmp_path / "table.fits", nanometers=[0.0, 60.0])
    found = read_shape(options(path, kind="modes", frame="mirror"))
    assert (found["unit"], found["values"]) == ("nm", [0.0, 60.0])


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        ({"a": [1.0], "b": [2.0]}, "found the columns a, b, expected one of coefficients"),
        ({"noll": [0], "a": [2.0]}, "found a noll beyond 1 to"),
        ({"noll": [4, 4], "a": [2.0, 3.0]}, "found a noll twice"),
    ],
)
def test_a_fits_table_that_is_ambiguous_is_refused(tmp_path, columns, text):
    with pytest.raises(ConfigurationError, match=text):
        read_shape(options(table_of(tmp_path / "table.fits", **columns), unit="nm"))


def test_a_map_may_have_nan_where_no_light_falls(tmp_path):
    y, x = (np.indices((40, 40)) + 0.5) / 20.0 - 1.0
    radius, path = np.hypot(x, y), tmp_path / "map.npy"
    np.save(path, np.where((radius < 1.0) & (radius > 0.2), x, np.nan))
    found = np.reshape(read_shape(options(path, frame="instrument", unit="nm"))["values"], x.shape)
    # A pixel in the dark has the value of one nearby.
    np.testing.assert_allclose(found[radius < 1.0], x[radius < 1.0], atol=0.25)
    lit = (radius < 1.0) & (radius > 0.2)
    np.testing.assert_allclose(found[lit], x[lit], rtol=1e-6)
    np.save(path, np.where((radius < 1.0) & (np.abs(x - 0.5) > 0.05), x, np.nan))
    with pytest.raises(ConfigurationError, match="values that are not finite"):
        read_shape(options(path, frame="instrument", unit="nm"))


def test_attributes_of_an_hdf5_file_say_what_its_numbers_are(tmp_path):
    path = tmp_path / "modes.h5"
    with h5py.File(path, "w") as file:
        file["modes"] = [0.0, 6e-8]
        file.attrs.update(kind="modes", frame="mirror", unit="m", basis_id="kl-90")
    found = read_shape(options(path))
    assert (found["kind"], found["frame"], found["unit"]) == ("modes", "mirror", "m")
    assert (found["basis_id"], found["values"]) == ("kl-90", [0.0, 6e-8])


def test_an_option_replaces_what_the_file_says(tmp_path):
    path = tmp_path / "modes.json"
    path.write_text(json.dumps({"kind": "modes", "frame": "mirror", "unit": "m", "values": [60]}))
    assert read_shape(options(path, unit="nm"))["unit"] == "nm"


def test_a_two_dimensional_array_is_a_map_row_by_row(tmp_path):
    path = tmp_path / "map.npy"
    np.save(path, [[1.0, 2.0], [3.0, 4.0]])
    found = read_shape(options(path, frame="instrument", unit="nm"))
    assert (found["kind"], found["values"]) == ("map", [1.0, 2.0, 3.0, 4.0])


def test_slopes_need_no_unit(tmp_path):
    path = tmp_path / "slopes.npy"
    np.save(path, [0.1, -0.2])
    assert "unit" not in read_shape(options(path, kind="slopes", frame="instrument"))


@pytest.mark.parametrize(
    ("content", "given", "text"),
    [
        (
            {"values": [60.0]},
            {},
            "found no kind and no frame and no unit: give --kind --frame --unit",
        ),
        ({"values": [60.0]}, {"kind": "modes", "frame": "mirror"}, "found no unit: give --unit"),
        ({"values": [60.0, float("nan")]}, {"kind": "slopes", "frame": "instrument"}, "1 values"),
        ({"numbers": [60.0]}, {}, "expected a JSON object with a list"),
        ({"values": ["a"]}, {}, "expected a JSON object with a list"),
        ([60.0], {}, "expected a JSON object with a list"),
    ],
)
def test_what_is_missing_or_not_finite_is_named(tmp_path, content, given, text):
    path = tmp_path / "shape.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigurationError, match=text):
        read_shape(options(path, **given))


def test_a_file_with_several_arrays_is_refused(tmp_path):
    path = tmp_path / "both.h5"
    with h5py.File(path, "w") as file:
        file["a"], file["b"] = [1.0], [2.0]
    with pytest.raises(ConfigurationError, match="expected one array"):
        read_shape(options(path))
