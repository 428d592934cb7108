"""The peers' study: what it tells a peer, and how it judges a fit."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from pyrcal_studies.peers import (
    KEPT_ANSWERS,
    LARGE,
    LISTINGS,
    Answer,
    Case,
    Question,
    bench,
    cases,
    digest,
    error,
    kept_answers,
    mirror_points,
    page,
    turned,
    write_instrument,
    write_reference,
)
from pyrcal_studies.peers_pushpull import (
    Bench,
    Measured,
    detector_from_pupil,
    push_pull,
    read_job,
    read_product,
    write_job,
    write_product,
)
from service.instrument import load_instrument
from service.model.kinds import Stop

BENCH = Bench(
    diameter_m=8.0,
    obscuration_ratio=0.2,
    n_subapertures=20,
    pupil_separation_subap=24,
    wavelength_m=750e-9,
    modulation_lambda_over_d=3.0,
    n_modulation=28,
    sampling=2,
)


class Looking:
    """A sensor of intensities: each image is the pupil's OPD, seen with columns along ``-y``."""

    version = "1"
    wavelength_m = 750e-9
    valid = np.ones((20, 20), dtype=bool)

    def __init__(self, *, obeys: bool = True) -> None:
        self.moved = (0, 0)
        self.obeys = obeys

    def frame(self, opd_m):
        light = 1.0 + opd_m * 1e6
        pixels = light.reshape(20, 2, 20, 2).mean(axis=(1, 3))
        image = np.pad(pixels.T[:, ::-1], 2)
        return np.tile(np.roll(image, self.moved, axis=(0, 1)), (2, 2))

    def slopes(self, opd_m):
        return self.frame(opd_m)[:24, :24].ravel() + 1e12 * opd_m.sum() ** 2

    def move_images(self, columns_px, rows_px):
        way = 1 if self.obeys else -1
        self.moved = (way * round(rows_px), way * round(columns_px))


def test_the_detectors_axes_are_found_by_poking_the_pupil():
    looks = detector_from_pupil(Looking(), BENCH)
    # (x, y) of the pupil as (columns, rows): columns run along -y, rows along +x.
    np.testing.assert_array_equal(looks, [[0, -1], [1, 0]])


def test_images_move_along_the_pupils_axes_whatever_way_the_detector_looks():
    peer = Looking()
    push_pull(peer, np.ones((1, 40, 40)), replace(BENCH, image_shift_subap=(2.0, 1.0)))
    assert peer.moved == (2, -1)


def test_a_peer_that_moves_its_images_the_other_way_is_not_believed():
    with pytest.raises(ValueError, match="were to move"):
        push_pull(
            Looking(obeys=False),
            np.ones((1, 40, 40)),
            replace(BENCH, image_shift_subap=(2.0, 0.0)),
        )


def test_push_pull_leaves_no_quadratic_part():
    shape = np.ones((1, 40, 40))
    matrix = push_pull(Looking(), shape, BENCH).matrix
    assert matrix[: 24 * 24].max() == pytest.approx(1e6)


def test_the_grey_pupil_holds_the_area_of_the_annulus():
    area = BENCH.amplitude().sum() / BENCH.sampling**2
    # 16 points across a cell: the area of a disc of 640 points across is good to 1e-4.
    assert area == pytest.approx(np.pi * 10**2 * (1 - 0.2**2), rel=2e-4)


def test_jobs_and_products_come_back_from_disk(tmp_path):
    told = replace(BENCH, image_shift_subap=(0.5, -0.25), misregistration=(0.1, 0.2, 2.0, 1.01))
    write_job(tmp_path / "job.npz", told, shapes_m=np.arange(3.0))
    back, arrays = read_job(tmp_path / "job.npz")
    assert back == told
    np.testing.assert_array_equal(arrays["shapes_m"], np.arange(3.0))
    write_product(tmp_path / "out.npz", _measured(), influence_functions=np.arange(2.0))
    measured, beside = read_product(tmp_path / "out.npz")
    assert (measured.version, measured.seconds) == ("1.0", 2.0)
    np.testing.assert_array_equal(measured.matrix, _measured().matrix)
    np.testing.assert_array_equal(beside["influence_functions"], np.arange(2.0))


def test_a_mirror_moved_with_the_telescope_as_stop_is_sampled_where_it_lies():
    case = Case(peer="oopao", stop=Stop.TELESCOPE, alpha=LARGE)
    n = bench(case).n_pupil
    corner = mirror_points(bench(case), case.alpha, case.stop)[-1]
    turn = LARGE.rotation_rad
    matrix = LARGE.magnification * np.array(
        [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    )
    on_pupil = (n - 1) / 2 / bench(case).sampling
    np.testing.assert_allclose(matrix @ corner + LARGE.vector[:2], [on_pupil, on_pupil])


def test_with_the_mirror_as_stop_the_images_take_the_shift_and_the_modes_do_not():
    case = Case(peer="hcipy", stop=Stop.MIRROR, alpha=LARGE)
    assert bench(case).image_shift_subap == (0.9, -0.7)
    centred = mirror_points(bench(case), case.alpha, case.stop)
    np.testing.assert_allclose(centred.mean(axis=0), 0.0, atol=1e-12)


def test_a_kept_matrix_is_measured_anew_when_anything_it_depends_on_changes():
    case = cases("hcipy")[0]
    assert digest(case, "hcipy==0.7.1") == digest(case, "hcipy==0.7.1")
    others = {digest(case, "hcipy==0.8"), *(digest(c, "hcipy==0.7.1") for c in cases("hcipy")[1:])}
    assert digest(case, "hcipy==0.7.1") not in others
    assert len(others) == 4


def test_the_instrument_file_of_every_peer_is_one_that_pyrcal_reads(tmp_path):
    for peer, listing in LISTINGS.items():
        case = cases(peer)[1]
        reference, toml = tmp_path / f"{peer}.h5", tmp_path / f"{peer}.toml"
        write_reference(reference, _measured(), None)
        write_instrument(toml, reference, case, _measured(), listing, case.stop)
        instrument = load_instrument(toml)
        assert (instrument.stop, instrument.modes.n_modes) == (Stop.MIRROR, 400)
        assert instrument.slopes.normalisation == listing.normalisation
        assert instrument.slopes.orientation is None
        np.testing.assert_array_equal(instrument.wfs.valid_subapertures, _mask())


def test_another_listing_holds_the_same_slopes_of_the_same_subapertures(tmp_path):
    seen = turned(_measured(), LISTINGS["oopao"])
    # Subaperture (row 3, column 5): the diagonal makes it (5, 3), rows from the end (24, 3).
    here = np.flatnonzero(np.flatnonzero(_mask()) == 3 * 30 + 5)[0]
    there = np.flatnonzero(np.flatnonzero(seen.valid) == 24 * 30 + 3)[0]
    n = int(_mask().sum())
    sx, sy = _measured().matrix[here], _measured().matrix[n + here]
    np.testing.assert_array_equal(seen.matrix[2 * there : 2 * there + 2], [-sy, -sx])
    write_reference(tmp_path / "r.h5", seen, None)
    with h5py.File(tmp_path / "r.h5") as file:
        assert file["interaction_matrix"].shape == (2 * n, 2)


def test_a_peer_that_lists_the_slope_along_the_rows_first_comes_out_x_first_all_the_same():
    rows_first = replace(LISTINGS["specula"], order="xy")
    n = int(_mask().sum())
    exchanged = replace(
        _measured(), matrix=np.vstack([_measured().matrix[n:], _measured().matrix[:n]])
    )
    np.testing.assert_array_equal(
        turned(exchanged, rows_first).matrix, turned(_measured(), LISTINGS["oopao"]).matrix
    )


def test_quarter_turns_of_the_sensors_axes_are_no_error():
    truth = (0.9, -0.5, 2.0, 1.02)
    as_found = {
        "shift_x_subap": 0.5,
        "shift_y_subap": 0.9,
        "rotation_deg": 92.0,
        "magnification": 1.02,
    }
    np.testing.assert_allclose(error(as_found, truth), 0.0, atol=1e-12)
    as_found["shift_x_subap"] = 0.501
    np.testing.assert_allclose(error(as_found, truth), [0.001, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("question", "shift", "residual", "accepted", "as_asked"),
    [
        (Question.ALL, 0.0019, 0.019, True, True),
        (Question.ALL, 0.0021, 0.019, True, False),
        (Question.ALL, 0.0019, 0.021, True, False),
        (Question.ALL, 0.0019, 0.019, False, False),
        (Question.FEW, 0.0049, 0.019, True, True),
        (Question.WRONG_STOP, 0.03, 0.1, False, True),
        (Question.WRONG_STOP, 0.0049, 0.1, True, True),
        (Question.WRONG_STOP, 0.0051, 0.01, True, False),
    ],
)
def test_an_answer_is_as_asked_when_near_accepted_and_small_in_residual(
    question, shift, residual, accepted, as_asked
):
    answer = Answer(
        case=cases("hcipy")[0],
        question=question,
        error=np.array([shift, -shift, 0.004, 0.0002]),
        sigma=np.full(4, 1e-3),
        residual=residual,
        accepted=accepted,
        verdict="as told",
        orientation={},
        seconds=1.0,
        right_error=np.array([0.002, -0.002, 0.004, 0.0002]),
    )
    assert answer.as_asked is as_asked


def test_the_answers_of_the_last_run_are_judged_again_from_what_was_said(tmp_path):
    case = cases("hcipy")[0]
    assert kept_answers(case, tmp_path) == []
    four = dict.fromkeys(("shift_x_subap", "shift_y_subap", "rotation_deg", "magnification"), 0.1)
    said = {
        "question": "20 lowest",
        "accepted": True,
        "shift_x_subap": 0.901,
        "shift_y_subap": -0.7,
        "rotation_deg": 2.0,
        "magnification": 1.02,
        "sigma": four,
        "residual_fraction": 0.01,
        "verdict": "accepted",
        "orientation": {},
        "seconds": 3.0,
    }
    all_modes = {**said, "question": "all modes", "shift_x_subap": 0.9005}
    wrong = {**said, "question": "wrong stop", "shift_x_subap": 1.201}
    lines = [json.dumps(one) for one in (all_modes, said, wrong)]
    (tmp_path / KEPT_ANSWERS).write_text("\n".join(lines) + "\n")
    _, answer, other = kept_answers(case, tmp_path)
    np.testing.assert_allclose(answer.error, [0.001, 0.0, 0.0, 0.0], atol=1e-12)
    assert answer.question is Question.FEW
    assert answer.as_asked
    assert other.change_sigma == pytest.approx(3.005)
    assert not other.as_asked


def test_the_page_tells_the_refusal_of_a_wrong_stop_and_what_was_missed():
    case = cases("hcipy")[0]
    right = Answer(
        case=case,
        question=Question.ALL,
        error=np.array([0.0021, 0.0, 0.0, 0.0]),
        sigma=np.full(4, 1e-3),
        residual=0.0123,
        accepted=True,
        verdict="accepted",
        orientation={},
        seconds=1.0,
    )
    wrong = replace(
        right, question=Question.WRONG_STOP, accepted=False, verdict='with stop = "x" the misfit'
    )
    text = page([(case, _measured())], [right, wrong])
    assert "| +0.210, +0.000 | +0.0000 | +0.0000 | 0.100 | 1.23% | **no** |" in text
    assert '| 0.0 | stop = "x" | yes |' in text
    assert "As asked: 1 of 2." in text


def _mask():
    mask = np.ones((30, 30), dtype=bool)
    mask[0] = mask[10:20, 14] = False
    return mask


def _measured() -> Measured:
    n = int(_mask().sum())
    return Measured(
        matrix=np.random.default_rng(1).normal(size=(2 * n, 2)),
        valid=_mask(),
        wavelength_m=750e-9,
        version="1.0",
        seconds=2.0,
        detector_from_pupil=np.eye(2),
    )
