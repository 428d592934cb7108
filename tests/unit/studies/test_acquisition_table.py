"""How acquisitions are counted."""

from pyrcal_studies.campaign.acquisition import RANGE, Start, table, wrong

ROW = {
    "instrument": "flao-lbt",
    "plant": "linear",
    "truth": "ideal",
    "magnitude": 10.0,
    "gain": 0.4,
    "n_controlled": 400,
    "stage": "tracking",
    "time_s": 17.0,
    "attempts": 1,
    "error": [0.003, -0.004, 0.005, 0.0002],
    "sigma": [0.008, 0.008, 0.024, 0.001],
    "radii": [0.64, None],
}


def cells(*rows):
    return [cell.strip() for cell in table(list(rows)).splitlines()[-1].split("|")[1:-1]]


def test_a_registration_far_from_the_truth_or_from_its_sigma_is_wrong():
    assert not wrong(ROW)
    assert wrong(ROW | {"error": [0.11, 0.0, 0.0, 0.0]})
    assert wrong(ROW | {"error": [0.0, 0.0, 0.13, 0.0]})
    assert wrong(ROW | {"error": [0.045, 0.0, 0.0, 0.0]})


def test_what_ended_without_a_registration_is_not_wrong():
    assert not wrong(ROW | {"stage": "failed", "error": None})


def test_every_ending_is_counted_once():
    failed = ROW | {"stage": "failed", "error": None, "attempts": 3}
    late = ROW | {"stage": "widening", "time_s": 90.0}
    unstable = ROW | {"time_s": 30.0, "radii": [1.01]}
    found = cells(ROW, unstable, failed, late)
    assert found[1:9] == ["4", "2 (50%)", "24, 30", "1", "1", "1", "0", "1"]


def test_telescopes_have_lines_of_their_own():
    rows = [ROW, ROW | {"instrument": "some/where/small.toml"}]
    assert len(table(rows).splitlines()) == 4


def test_starts_are_drawn_from_the_whole_range_and_always_the_same():
    drawn = [Start(seed=seed).alpha - [0.0, 0.0, 0.0, 1.0] for seed in range(200)]
    assert all((abs(alpha) <= RANGE).all() for alpha in drawn)
    assert (abs(min(drawn, key=lambda alpha: alpha[0])[0]) > 0.95 * RANGE[0]).all()
    assert (Start(seed=3).alpha == Start(seed=3, plant="diffractive").alpha).all()
