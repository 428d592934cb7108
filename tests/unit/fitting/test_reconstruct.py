import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from pyrcal.arguments import command_line, with_negative_numbers
from pyrcal.fitting.arguments import check_files
from pyrcal.fitting.control_check import ReconstructorVerdict
from pyrcal.fitting.reconstruct import SAMPLING, main
from pyrcal.fitting.report import document, fill_fit
from service.errors import ConfigurationError, MatrixError, ModelError
from service.files.whole import write_whole
from service.instrument import load_instrument
from service.model.instrument import instrument_sha256
from service.model.interaction import InteractionModel, RtcInteractionModel
from service.model.kinds import SlopeOrder
from service.model.misregistration import Misregistration
from service.model.modes import modal_basis
from service.model.slopes import Orientation, SlopeRecipe, rtc_mask, to_conventions
from tests.support.made import a_fit, a_report
from tests.support.reconstruct import TINY

WORDS = "-0.31,0.17,64.2,0.985"
ALPHA = Misregistration.from_boundary(
    {
        "shift_x_subap": -0.31,
        "shift_y_subap": 0.17,
        "rotation_deg": 64.2,
        "magnification": 0.985,
    }
)
GAINS = np.linspace(0.9, 1.1, 40)


@pytest.fixture(autouse=True)
def empty_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def made(alpha, *more, modes="50"):
    given = ["reconstruct", str(TINY), alpha, "--modes", modes, "--output", "cm.h5", *more]
    options = command_line().parse_args(with_negative_numbers(given))
    check_files(options)
    assert main(options) == 0
    return h5py.File("cm.h5", "r")


def a_tiny_report(**changes):
    """A fit of the first 40 modes as if the file had been fitted; rows from the top."""
    fit = a_fit(
        alpha=ALPHA,
        modes=np.arange(40),
        gains=GAINS,
        orientation=Orientation(flip_y=True),
        order=SlopeOrder.YX,
        **changes,
    )
    return a_report(fit, instrument_sha256=instrument_sha256(load_instrument(TINY)))


def kept(report):
    write_whole(Path("fit.h5"), lambda file: fill_fit(file, report))
    return "fit.h5"


def model_matrix():
    instrument = load_instrument(TINY)
    model = InteractionModel(
        instrument, modal_basis(instrument), pupil_sampling=SAMPLING, detector_nodes=SAMPLING
    )
    return model, model.interaction_matrix(ALPHA)


def test_it_inverts_the_model_at_the_registration_given():
    with made(WORDS) as file:
        product = file["reconstructor"][()] @ file["interaction_matrix"][()]
        assert file["reconstructor"].shape[0] == 50
    np.testing.assert_allclose(product, np.eye(50), atol=1e-4)


def test_more_modes_than_were_measured_may_be_controlled():
    with made(kept(a_tiny_report())) as file:
        assert file["reconstructor"].shape[0] == 50
        assert (file.attrs["n_gains_measured"], file.attrs["n_gains_extended"]) == (40, 10)


def test_slopes_are_listed_as_the_fit_found_the_rtc_to_list_them():
    model, expected = model_matrix()
    orientation = Orientation(flip_y=True)
    with made(kept(a_tiny_report()), "--no-gains") as file:
        found = file["interaction_matrix"][()]
    mask = rtc_mask(model.valid, orientation)
    back = to_conventions(found, SlopeRecipe(order=SlopeOrder.YX, orientation=orientation), mask)
    np.testing.assert_allclose(back, expected[:, :50], rtol=1e-5, atol=1.0)


def test_the_columns_take_the_gains_of_the_fit():
    fitted = kept(a_tiny_report())
    with made(fitted) as file:
        tuned = file["interaction_matrix"][()]
    Path("cm.h5").unlink()
    with made(fitted, "--no-gains") as file:
        plain = file["interaction_matrix"][()]
    gains = np.linalg.norm(tuned, axis=0) / np.linalg.norm(plain, axis=0)
    np.testing.assert_allclose(gains[:40], GAINS, rtol=1e-5)
    assert gains[40:] == pytest.approx(np.median(GAINS[-25:]))


def test_it_says_what_it_was_made_of():
    with made(kept(a_tiny_report()), "--method", "map") as file:
        facts = dict(file.attrs)
        assert file["covariance"].shape == (4, 4)
    assert facts["source"] == "synthetic"
    assert facts["method"] == "map"
    assert facts["prior_slope_noise"] == pytest.approx(0.05)
    assert facts["shift_x_subap"] == -0.31
    assert facts["sigma_rotation_deg"] == pytest.approx(0.01)
    assert facts["reference_sha256"] == "2" * 64
    assert facts["reference_passes"] == 2
    assert facts["instrument_sha256"] == instrument_sha256(load_instrument(TINY))
    assert facts["model_pupil_sampling"] == SAMPLING
    assert facts["software"].startswith("pyrcal ")
    assert facts["created_utc"].endswith("+00:00")
    assert json.loads(facts["slopes"])["flip_y"] is True


def test_the_json_of_a_fit_will_do():
    Path("fit.json").write_text(json.dumps(document(a_tiny_report())), encoding="utf-8")
    with made("fit.json") as file:
        assert file.attrs["rotation_deg"] == pytest.approx(64.2)
        assert json.loads(file.attrs["slopes"])["order"] == "yx"
        assert "calibration_gains" not in file, "JSON does not say which modes the gains belong to"


def test_a_model_lit_as_a_flux_map_says_says_so():
    counts = np.zeros((4, 12, 12))
    y, x = np.mgrid[:12, :12] - 5.5
    counts[:] = 1000.0 * (np.hypot(x, y) < 6.0) * (1.0 + 0.02 * x)
    with h5py.File("flux.h5", "w") as file:
        file["flux"] = counts
    with made(kept(a_tiny_report())) as file:
        even = file["interaction_matrix"][()]
        assert not file.attrs["measured_illumination"]
    Path("cm.h5").unlink()
    with made("fit.h5", "--flux-map", "flux.h5") as file:
        lit = file["interaction_matrix"][()]
        assert file.attrs["measured_illumination"]
    assert 0.005 < np.linalg.norm(lit - even) / np.linalg.norm(even) < 0.2


def test_an_instrument_that_has_changed_since_is_said(capsys):
    report = a_report(a_tiny_report().fit, instrument_sha256="0" * 64)
    made(kept(report)).close()
    assert "has changed since" in capsys.readouterr().err


def checked(**changes):
    """The loop of the measured matrix as a fit found it."""
    values = {
        "stable_modes": 30,
        "n_modes": 40,
        "gain": 0.5,
        "pole_radius": 0.8,
        "pole_radius_all": 1.1,
        "aligned_pole_radius": 0.707,
        "loss_ratio": 1.1,
        "noise_limited": False,
        "weakest_modes": (31,),
        "reason": "stable up to 30 of 40 modes at gain 0.5",
    }
    return ReconstructorVerdict(**values | changes)


def refused(source, **changes):
    report = a_tiny_report(accepted=False, verdict="refused: sets of modes disagree", **changes)
    kept(report)
    Path("fit.json").write_text(json.dumps(document(report)), encoding="utf-8")
    return source


SOURCES = pytest.mark.parametrize("source", ["fit.h5", "fit.json"])


@SOURCES
def test_a_refused_fit_that_says_nothing_of_the_loop_makes_no_reconstructor(source):
    with pytest.raises(MatrixError, match="was not determined"):
        made(refused(source))
    assert not Path("cm.h5").exists()


@SOURCES
def test_more_modes_than_hold_the_measured_loop_are_refused_with_the_way_round(source):
    with pytest.raises(MatrixError, match=r"stable up to 30 modes; use --modes 30"):
        made(refused(source, reconstructor=checked()))
    assert not Path("cm.h5").exists()


@SOURCES
def test_modes_that_hold_the_measured_loop_are_made_whatever_the_registration(source, capsys):
    made(refused(source, reconstructor=checked()), modes="30")
    assert "was not determined" in capsys.readouterr().err


def test_where_all_fitted_modes_hold_more_may_be_asked_for():
    made(refused("fit.h5", reconstructor=checked(stable_modes=40)), modes="50")


def test_the_measured_file_is_checked_against_the_fits():
    Path("im.h5").write_bytes(b"another")
    with pytest.raises(MatrixError, match="found checksum"):
        made(kept(a_tiny_report()), "--reference", "im.h5")


def test_the_checksum_of_the_measured_file_may_be_given():
    Path("im.h5").write_bytes(b"measured")
    with made(WORDS, "--reference", "im.h5") as file:
        assert len(file.attrs["reference_sha256"]) == 64


@pytest.mark.parametrize(
    ("alpha", "more", "error", "said"),
    [
        ("0,0,0", (), ConfigurationError, "expected X,Y,ROT,MAG"),
        ("none.json", (), ConfigurationError, "no such file"),
        (WORDS, ("--modes", "61"), ModelError, "expected 1 to 60"),
        (WORDS, ("--output", "none/cm.h5"), ConfigurationError, "found no folder none"),
        (WORDS, ("--method", "map", "--slope-noise", "0"), ModelError, "slope_noise"),
        (WORDS, ("--max-condition", "0.5"), ConfigurationError, "at least 1"),
    ],
)
def test_what_cannot_be_used_is_one_sentence(alpha, more, error, said):
    with pytest.raises(error, match=said) as found:
        made(alpha, *more)
    assert "\n" not in str(found.value)


def test_a_file_that_is_no_fit_is_refused():
    Path("fit.json").write_text("[1, 2]", encoding="utf-8")
    with pytest.raises(MatrixError, match="expected what pyrcal fit wrote"):
        made("fit.json")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("gains", np.array(1.0)),
        ("gains", np.ones((40, 2))),
        ("gains", np.ones(39)),
        ("gains", np.full(40, np.inf)),
        ("gains", np.full(40, b"x")),
        ("modes", np.array(3)),
        ("modes", np.arange(40.0) + 0.5),
        ("modes", np.full(40, np.nan)),
        ("modes", np.arange(40.0) * 1e30),
    ],
)
def test_damaged_gains_or_modes_of_a_fit_are_refused(name, values):
    path = kept(a_tiny_report())
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = values
    with pytest.raises(MatrixError, match=r"fit\.h5"):
        made(path)
    assert not Path("cm.h5").exists()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("covariance", [[1.0, 2.0]]),
        ("covariance", [[float("nan")] * 4] * 4),
        ("anamorphosis", [0.01]),
        ("anamorphosis", [0.01, 0.02, 0.03]),
        ("image_offsets_px", [[0.1, 0.2]] * 3),
        ("image_offsets_px", [[0.1, 0.2, 0.3]] * 4),
        ("image_offsets_px", 3.0),
    ],
)
def test_a_document_with_an_array_of_another_shape_is_refused(name, values):
    written = document(a_tiny_report()) | {name: values}
    Path("fit.json").write_text(json.dumps(written), encoding="utf-8")
    with pytest.raises(MatrixError, match=r"fit\.json"):
        made("fit.json")
    assert not Path("cm.h5").exists()


def test_pupil_images_that_the_fit_found_displaced_are_so_in_the_reconstructors_model(capsys):
    """As the instrument file would say it; on the pixel grid D would differ by much more."""
    places = np.array([[0.2, 0.1], [-0.2, 0.0], [0.1, -0.2], [-0.1, 0.1]])
    with made(kept(a_tiny_report(image_offsets_px=places)), "--no-gains") as file:
        found = file["interaction_matrix"][()]
    assert "image_offsets_px = [[0.20, 0.10]" in capsys.readouterr().err
    instrument = load_instrument(TINY)
    slopes = replace(instrument.slopes, orientation=Orientation(flip_y=True), order=SlopeOrder.YX)
    told = replace(
        instrument,
        slopes=slopes,
        wfs=replace(instrument.wfs, image_offsets_subap=tuple(map(tuple, places))),
    )
    model = RtcInteractionModel(
        told, modal_basis(told), pupil_sampling=SAMPLING, detector_nodes=SAMPLING
    )
    expected = model.interaction_matrix(ALPHA)[:, :50]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    on_grid = model_matrix()[1][:, :50]
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(expected))
    assert abs(np.linalg.norm(on_grid) / np.linalg.norm(found) - 1.0) > 1e-3
