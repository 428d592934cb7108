import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.report import document, fill_fit, read_fit
from service.errors import MatrixError
from service.model.instrument import instrument_sha256
from service.model.kinds import SlopeOrder, Stop
from service.model.slopes import Orientation
from tests.numerics import small_instrument
from tests.unit.fitting.made import ALPHA, GAINS, SCAN, a_fit, a_report


@pytest.fixture
def path(tmp_path):
    return tmp_path / "fit.h5"


def written(path, report):
    with h5py.File(path, "w") as file:
        fill_fit(file, report)
    return path


def test_the_file_holds_what_json_cannot(path):
    with h5py.File(written(path, a_report(a_fit(paper_table=(SCAN,)))), "r") as file:
        assert file["residual_map"].shape == (2, 3, 3)
        assert file["measured"].shape == file["synthetic"].shape == (10, 3)
        assert file["modes"][()].tolist() == [0, 1, 4]
        assert file["paper_table/00"].attrs["parameter"] == "rotation_deg"
        assert "gain_map" not in file, "it was not asked for"
        assert all(file[name].attrs["description"] for name in ("gains", "covariance"))


def test_the_file_says_where_it_comes_from_and_holds_the_document(path):
    report = a_report(notes=("the model is lit as the flux map says",))
    with h5py.File(written(path, report), "r") as file:
        assert json.loads(file.attrs["document"]) == document(report)
        assert file.attrs["reference_sha256"] == "2" * 64
        assert file.attrs["instrument_sha256"] == "1" * 64
        assert file.attrs["double_pass"]
        assert "flux map" in file.attrs["notes"]
        assert file.attrs["rotation_deg"] == pytest.approx(65.08)


def test_a_product_gives_back_the_fit(path):
    fit = read_fit(written(path, a_report()))
    np.testing.assert_allclose(fit.alpha.vector, ALPHA.vector)
    np.testing.assert_allclose(fit.covariance, a_fit().covariance)
    np.testing.assert_allclose(fit.gains, GAINS)
    assert fit.modes.tolist() == [0, 1, 4]
    assert fit.orientation == Orientation(flip_x=True, sign_y=-1)
    assert fit.order is SlopeOrder.YX
    assert (fit.double_pass, fit.accepted) == (True, True)


def test_a_document_gives_back_what_it_has(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(document(a_report(a_fit(accepted=False, verdict="refused: x")))))
    fit = read_fit(path)
    np.testing.assert_allclose(fit.covariance, a_fit().covariance)
    assert fit.accepted is False
    assert fit.gains is None
    assert fit.reference_sha256 is None


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b"\xff\xfe", b'{"orientation": 3}'])
def test_another_file_is_refused(tmp_path, content):
    path = tmp_path / "fit.json"
    path.write_bytes(content)
    with pytest.raises(MatrixError, match="expected what pyrcal fit wrote"):
        read_fit(path)


def test_another_hdf5_file_is_refused(path):
    with h5py.File(path, "w") as file:
        file["interaction_matrix"] = np.eye(3)
    with pytest.raises(MatrixError, match="expected what pyrcal fit wrote"):
        read_fit(path)


def test_the_same_instrument_has_the_same_number():
    assert instrument_sha256(small_instrument()) == instrument_sha256(small_instrument())


def test_it_has_the_number_that_fits_of_before_know_it_by():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    told = instrument_sha256(small_instrument(positions_m=corners))
    assert told == "24097de8dd098eeed652d3a9ce41997aa338ae08b0221ad6d3b8645da98514b0"


def test_every_change_of_an_instrument_changes_it():
    one = small_instrument()
    moved = one.mirror.positions_m.copy()
    moved[3, 1] += 1e-9
    others = [
        small_instrument(stop=Stop.TELESCOPE),
        replace(one, diameter_m=np.nextafter(8.0, 9.0)),
        replace(one, mirror=replace(one.mirror, positions_m=moved)),
    ]
    assert len({instrument_sha256(other) for other in (one, *others)}) == 4


def test_remarks_on_the_file_are_not_part_of_the_instrument():
    one = small_instrument()
    assert instrument_sha256(replace(one, remarks=("a.toml: odd",))) == instrument_sha256(one)
