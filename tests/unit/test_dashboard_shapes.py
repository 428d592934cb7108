"""Files with shapes as the page reads them; its modules run in node here."""

import base64
import io
import json
import shutil
import subprocess

import numpy as np
import pytest
from astropy.io import fits

from service.web.page import FILES

NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="no node: apt install nodejs")


def read(name, content):
    """What the page reads in a file, or the text of its error."""
    script = f"""
      import {{ rmsOf, shapeOf }} from '{(FILES / "shapes").as_uri()}.js';
      const bytes = Buffer.from('{base64.b64encode(content).decode()}', 'base64');
      const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
      try {{
        const found = shapeOf({json.dumps(name)}, buffer);
        console.log(JSON.stringify({{ ...found, rms: rmsOf(found.kind, found.values) }}));
      }} catch (error) {{
        console.log(JSON.stringify(error.message));
      }}
    """
    command = [NODE, "--input-type=module", "--no-warnings", "-e", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


def fits_of(values, extension=False, **cards):
    image = (fits.ImageHDU if extension else fits.PrimaryHDU)(values)
    for key, value in cards.items():
        image.header[key] = value
    whole, file = ([fits.PrimaryHDU(), image] if extension else [image]), io.BytesIO()
    fits.HDUList(whole).writeto(file)
    return file.getvalue()


def numpy_of(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize("extension", [False, True])
@pytest.mark.parametrize("kind", [">f4", ">f8", ">i2", ">i4"])
def test_zernike_coefficients_in_fits_with_their_unit(kind, extension):
    values = np.array([0, 0, 0, 12, 60, -5], kind)
    found = read("ncpa.FITS", fits_of(values, extension, BUNIT="nm", KIND="zernike"))
    assert (found["values"], found["unit"], found["kind"]) == (values.tolist(), "nm", "zernike")
    assert found["rms"] == pytest.approx(np.linalg.norm([12, 60, 5]))


def test_fits_numbers_are_scaled_as_their_header_says():
    raw = fits.PrimaryHDU(np.array([1, 2, 3], ">i2"))
    file = io.BytesIO()
    raw.writeto(file)
    # two empty cards of the only header block say how the integers are to be read
    data = file.getvalue()
    cards = b"BSCALE  =                  0.5".ljust(80) + b"BZERO   =                 10.0".ljust(
        80
    )
    end = data.index(b"END" + b" " * 77)
    data = data[:end] + cards + data[end:2720] + data[2880:]
    assert read("a.fits", data)["values"] == [10.5, 11.0, 11.5]


@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i8", "<u2"])
def test_numbers_of_numpy_in_any_order_of_bytes(kind):
    values = np.array([3, 0, 4], kind)
    assert read("a.npy", numpy_of(values))["values"] == [3, 0, 4]


def test_a_square_is_a_map_and_its_mean_is_no_shape():
    found = read("map.npy", numpy_of(np.array([[1.0, 3.0], [1.0, 3.0]])))
    assert (found["kind"], found["values"], found["rms"]) == ("map", [1, 3, 1, 3], 1.0)


def test_a_fits_table_has_coefficients_by_their_numbers():
    columns = [
        fits.Column(name="NOLL", format="J", array=[6, 4]),
        fits.Column(name="amplitude", format="D", array=[60.0, -5.0], unit="nm"),
    ]
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(file)
    found = read("a.fits", file.getvalue())
    assert (found["kind"], found["unit"]) == ("zernike", "nm")
    assert found["values"] == [0, 0, 0, -5, 0, 60]
    columns.append(fits.Column(name="sigma", format="E", array=[1.0, 1.0]))
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(file)
    assert "found the columns noll, amplitude, sigma" in read("a.fits", file.getvalue())


def test_a_map_may_have_nan_where_no_light_falls():
    y, x = (np.indices((20, 20)) + 0.5) / 10.0 - 1.0
    radius = np.hypot(x, y)
    lit = (radius < 1.0) & (radius > 0.2)
    found = read("map.npy", numpy_of(np.where(lit, x, np.nan)))
    values = np.reshape(found["values"], x.shape)
    np.testing.assert_allclose(values[lit], x[lit])
    np.testing.assert_allclose(values[radius < 1.0], x[radius < 1.0], atol=0.25)
    hole = lit & (np.abs(x - 0.5) > 0.06)
    assert "not finite" in read("map.npy", numpy_of(np.where(hole, x, np.nan)))


def test_what_a_document_says_of_its_numbers_is_kept():
    document = {
        "kind": "modes",
        "frame": "mirror",
        "unit": "nm",
        "values": [3, 4],
        "basis_id": "kl",
    }
    found = read("a.json", json.dumps(document).encode())
    assert found == {"kind": "modes", "unit": "nm", "values": [3, 4], "basis_id": "kl", "rms": 5}


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", b"1,2", "expected .json, .npy or .fits"),
        ("a.npy", numpy_of(np.array([1.0, np.nan])), "found 1 values that are not finite"),
        ("a.npy", numpy_of(np.array([1j])), "expected an array of numbers"),
        ("a.npy", numpy_of(np.zeros(9))[:-8], "found fewer than the 9 numbers"),
        ("a.npy", b"\x93NUMPI\x01\x00", "found no NumPy file"),
        ("a.json", b'{"values": ["x"]}', "expected a list of numbers"),
        ("a.json", b'{"value": [1]}', "expected a list of numbers"),
        ("a.fits", fits_of(None), "found no array"),
        ("a.fits", fits_of(np.zeros(9))[:2900], "found fewer than the 9 numbers"),
    ],
)
def test_a_file_without_a_shape_is_refused_with_what_was_found(name, content, says):
    assert says in read(name, content)
