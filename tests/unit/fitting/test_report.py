import json
import tomllib
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal.fitting.comparison import Alternative
from pyrcal.fitting.fit_table import table
from pyrcal.fitting.instrument_checks import FoundOptic
from pyrcal.fitting.left_over import Arm, ResidualLocation
from pyrcal.fitting.models import Optic
from pyrcal.fitting.origins import Origin
from pyrcal.fitting.report import document, fill_fit, read_fit
from service.errors import MatrixError
from service.model.instrument import instrument_sha256
from service.model.kinds import SlopeOrder, Stop
from service.model.misregistration import PARAMETERS
from service.model.slopes import Orientation
from tests.support.fit_keys import KEYS
from tests.support.made import ALPHA, GAINS, SCAN, a_fit, a_report
from tests.support.numerics import small_instrument


def test_the_document_has_exactly_the_keys_it_promises():
    found = document(a_report())
    assert set(found) == KEYS
    assert set(found["sigma"]) == set(found["subset_scatter"]) == set(PARAMETERS)


def test_every_number_is_in_the_unit_of_its_name():
    found = document(a_report())
    assert found["rotation_deg"] == pytest.approx(65.08)
    assert found["sigma"]["rotation_deg"] == pytest.approx(0.01)
    assert found["covariance"][2][2] == pytest.approx(0.01**2)
    assert found["subset_scatter"]["rotation_deg"] == pytest.approx(0.004)
    assert found["shift_x_subap"] == -0.92
    assert found["sigma"]["shift_y_subap"] == pytest.approx(0.02)
    assert found["gains"] == GAINS.tolist()
    assert found["n_modes_used"] == 3


def test_the_orientation_is_said_as_the_instrument_file_would():
    found = document(a_report())["orientation"]
    assert found == {
        "order": "yx",
        "swap_xy": False,
        "flip_x": True,
        "flip_y": False,
        "sign": [1, -1],
    }
    both = a_fit(orientation=Orientation(sign_x=-1, sign_y=-1))
    assert document(a_report(both))["orientation"]["sign"] == -1


def test_what_should_be_known_beside_the_verdict_is_in_the_document():
    assert document(a_report(notes=("columns of the wrong sign: 3",)))["notes"] == [
        "columns of the wrong sign: 3"
    ]


def test_what_was_left_out_is_named_in_the_verdict():
    fit = a_fit(left_out=("not finite: mode 2", "dead (no response): mode 3"))
    verdict = document(a_report(fit))["verdict"]
    assert verdict.startswith("accepted")
    assert "mode 2" in verdict
    assert "mode 3" in verdict
    assert "\n" not in verdict


def test_a_number_that_is_none_is_null():
    fit = a_fit(
        accepted=False,
        covariance=np.full((4, 4), np.inf),
        gains=np.array([1.0, np.nan, 0.9]),
        residual_fraction=np.nan,
        subset_scatter=np.full(4, np.nan),
    )
    found = json.loads(json.dumps(document(a_report(fit)), allow_nan=False))
    assert found["gains"] == [1.0, None, 0.9]
    assert found["residual_fraction"] is None
    assert found["sigma"] == dict.fromkeys(PARAMETERS)


def line(text, name):
    (found,) = [line for line in text.splitlines() if line.startswith(name)]
    return found


def test_what_to_do_comes_first_and_then_the_verdict():
    advised = "do not use it: the stop is another"
    fit = a_fit(
        accepted=False,
        verdict="refused: sets of modes disagree; check the stop",
        recommendation=advised,
    )
    assert table(a_report(fit)).splitlines()[:2] == [advised, fit.verdict]


RIVALS = (
    Alternative(
        words='stop = "mirror"',
        share=0.5,
        moved=np.array([0.02, 0.0, np.deg2rad(0.1), 0.0]),
        preferred=True,
    ),
    Alternative(
        words="no anamorphosis fitted",
        share=1.001,
        moved=np.array([0.002, 0.0, 0.0, 0.0]),
        undecided=True,
    ),
    Alternative(words="the lower half of the modes", share=None, moved=np.full(4, 1e-3)),
)


def test_what_else_was_tried_is_counted_and_the_largest_move_named():
    text = table(a_report(a_fit(alternatives=RIVALS)))
    assert "3 tried, 1 preferred: see notes" in line(text, "alternatives")
    assert "by up to 0.2 sigma (no anamorphosis fitted)" in text
    assert "other weights and modes: by up to 5.7 sigma (the lower half of the modes)" in text


def test_alternatives_are_told_in_the_units_of_their_names_and_in_sigma():
    first, _, last = document(a_report(a_fit(alternatives=RIVALS)))["alternatives"]
    assert first["words"] == 'stop = "mirror"'
    assert first["misfit"] == 0.5
    assert first["moved"]["rotation_deg"] == pytest.approx(0.1)
    assert first["moved_sigma"]["rotation_deg"] == pytest.approx(10.0)
    assert first["moved_sigma"]["shift_x_subap"] == pytest.approx(2.0)
    assert first["preferred"]
    assert last["misfit"] is None


def test_what_was_found_rather_than_told_has_its_line():
    order = Origin(
        key="order", found='"yx"', reported='"xy"', how="scanned: the lowest modes", correct=True
    )
    report = a_report(a_fit(origins=(order,)))
    assert line(table(report), "determined by fit").endswith(
        'order = "yx" (scanned: the lowest modes; the file says "xy")'
    )
    assert document(report)["found_not_told"] == [
        {
            "key": "order",
            "found": '"yx"',
            "told": '"xy"',
            "how": "scanned: the lowest modes",
            "correct": True,
        }
    ]


def test_what_was_found_is_said_once_and_its_key_whole():
    key = "modulation_lambda_over_d"
    told = FoundOptic(
        optic=Optic.SENSOR, key=key, change=0.01, sigma=0.003, found=3.02, reported=3.0
    )
    assert line(table(a_report(a_fit(optics=(told,)))), key).startswith(f"{key} 3.02 +- ")
    unknown = replace(told, reported=None)
    origin = Origin(key=key, found="3.02", reported='"unknown"', how="fitted", correct=True)
    fit = a_fit(optics=(unknown,), origins=(origin,))
    notes = (
        f"bench.toml: wfs.{key}: unknown; a fit of a measured matrix finds it",
        f"{key} = 3.02 was found, 1 sigma 0.009: write it into the instrument file",
        f"with {key} = 3.02 the misfit is less",
    )
    text = table(a_report(fit, notes=notes))
    assert [row for row in text.splitlines() if key in row] == [
        line(text, "determined by fit"),
        f"note: {notes[2]}",
    ]


def test_where_something_is_left_over_is_told():
    left = ResidualLocation(
        border=2.5,
        subapertures=((1, 2, 0.4),),
        modes=((4, 0.3),),
        arms=(Arm(angle_deg=120.0, offset_subap=-1.5, excess=2.0),),
        planes=(0.9, 1.1),
    )
    report = a_report(a_fit(left_over=left))
    text = table(report)
    assert "2.5 times as much at the pupil's border as inside" in text
    assert "row 1 column 2" in text
    assert "4 (30%)" in text
    assert "120 deg, -1.5 subapertures off" in text
    assert document(report)["left_over"] == {
        "border": 2.5,
        "subapertures": [{"row": 1, "column": 2, "share": 0.4}],
        "modes": [{"mode": 4, "share": 0.3}],
        "arms": [{"angle_deg": 120.0, "offset_subap": -1.5, "excess": 2.0}],
        "planes": [0.9, 1.1],
        "gradient": [0.0, 0.0],
    }


def test_the_four_parameters_are_there_with_unit_and_uncertainty():
    text = table(a_report())
    assert line(text, "shift x").split() == [
        "shift",
        "x",
        "-0.9200",
        "0.0100",
        "0.0010",
        "subapertures",
    ]
    assert line(text, "rotation").split() == ["rotation", "65.0800", "0.0100", "0.0040", "deg"]
    numbers = line(text, "magnification").split()[1:4]
    assert numbers == ["0.98000", "0.00100", "0.00010"]
    assert "ratio, image of the mirror" in line(text, "magnification")


def test_the_slopes_are_printed_as_the_instrument_file_takes_them():
    written = line(table(a_report()), "slopes").removeprefix("slopes").strip()
    order, orientation = written.split(", ", maxsplit=1)
    assert tomllib.loads(f"{order}\n{orientation}") == {
        "order": "yx",
        "orientation": {"swap_xy": False, "flip_x": True, "flip_y": False, "sign": [1, -1]},
    }


def test_what_was_left_out_is_named():
    assert "mode 17" in line(table(a_report(a_fit(left_out=("dead: mode 17",)))), "left out")


def test_modes_are_told_as_ranges():
    assert "3 (0 to 1, 4)" in line(table(a_report()), "modes used")


def test_a_gain_far_from_the_others_is_named():
    fit = a_fit(gains=np.array([1.0, 1.02, 0.5]))
    assert "mode 4" in line(table(a_report(fit)), "gains")
    assert "off" not in line(table(a_report()), "gains")


def test_the_papers_table_has_a_line_for_every_step():
    text = table(a_report(a_fit(paper_table=(SCAN, SCAN))))
    assert line(text, "   2").split() == [
        "2",
        "rotation",
        "64.5000",
        "65.5000",
        "0.5000",
        "65.0000",
        "deg",
    ]


def test_what_was_asked_beside_the_four_is_told():
    fit = a_fit(**stretched(0.0003), gain_map=np.full((3, 3), 0.9))
    text = table(a_report(fit, notes=("double pass: no, as the measured file says",)))
    assert "+0.100 +- 0.030 % along x, -0.200" in line(text, "anamorphosis")
    assert "0.90 to 0.90" in line(text, "gain over the pupil")
    assert "double pass: no" in line(text, "note")


def stretched(sigma):
    alpha = ALPHA.with_anamorphosis(np.array([0.001, -0.002]))
    return {"alpha": alpha, "anamorphosis_sigma": np.full(2, sigma)}


def test_an_anamorphosis_that_the_modes_do_not_tell_is_said_to_be_none():
    unsure = a_report(a_fit(**stretched(0.015)))
    assert document(unsure)["anamorphosis"] is None
    assert document(unsure)["anamorphosis_sigma"] == [0.015, 0.015]
    assert "not observable with these modes" in line(table(unsure), "anamorphosis")


def test_a_fit_that_is_read_back_has_its_anamorphosis(tmp_path):
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(document(a_report(a_fit(**stretched(0.0003))))))
    assert read_fit(path).alpha.anamorphosis == (0.001, -0.002)


def test_a_refused_fit_without_a_size_is_still_told():
    fit = a_fit(
        accepted=False,
        gains=np.full(3, np.nan),
        residual_fraction=np.nan,
        covariance=np.full((4, 4), np.nan),
    )
    assert line(table(a_report(fit)), "shift x").split() == [
        "shift",
        "x",
        "-0.9200",
        "-",
        "0.0010",
        "subapertures",
    ]


def test_what_a_file_says_of_itself_cannot_write_lines_of_the_table():
    evil = "\x1b[2J\naccepted: by a stranger"
    text = table(a_report(reference=evil, notes=(evil,)))
    assert "\x1b" not in text
    assert "\naccepted: by a stranger" not in text


# --- the product


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
