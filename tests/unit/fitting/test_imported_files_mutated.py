"""What is wrong in a file of OOPAO, SPECULA or SynIM is refused, mended and said, or breaks a rule;
and a fit of it is refused, or right but for its axes, with what was found said.
"""

from dataclasses import replace

import numpy as np
import pytest

from pyrcal.conventions import check
from pyrcal.fitting.matrix import fit_matrix
from service.errors import ConfigurationError, MatrixError, ModelError
from service.estimation.reference import Reference
from service.instrument import load_instrument
from tests.support.imported_mutations import MENDED, OF, PEERS, REFUSED, SLOW

CASES = [
    pytest.param(peer, name, marks=[pytest.mark.long] * ((peer, name) in SLOW))
    for peer, of_it in OF.items()
    for name in of_it
]
SEEN_BY_A_FIT = (
    *("all signs", "sign of the first half", "halves exchanged", "subapertures from the last"),
    *("transposed", "two modes exchanged", "one mode of the other sign", "of both passes"),
    *("in another unit, 1e-3", "places by columns", "places from below"),
    *("interleaved and not said", "functions from below"),
)
FITTED = [
    pytest.param(*one.values, marks=one.marks or [pytest.mark.long] * (one.values[0] == "specula"))
    for one in CASES
    if one.values[1] in SEEN_BY_A_FIT
]


def imported(peer, given, folder):
    found = PEERS[peer].to_import(given, folder)
    return found, load_instrument(found.save(folder / "bench").instrument)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return {
        name: imported(name, peer.read(), tmp_path_factory.mktemp(name))
        for name, peer in PEERS.items()
    }


def stated(peer, instrument):
    """Return the instrument with what its user knows of axes and signs."""
    told = PEERS[peer]
    slopes = replace(instrument.slopes, order=told.order, orientation=told.orientation)
    mirror = replace(instrument.mirror, nominal_rotation_rad=0.0, parity=1)
    return replace(instrument, slopes=slopes, mirror=mirror)


def broken(peer, found, instrument):
    findings = check(stated(peer, instrument), found.arrays["interaction_matrix"])
    return {one.rule for one in findings if not one.kept}


def same(one, other):
    return one.keys() == other.keys() and all(
        np.array_equal(one[k], other[k], equal_nan=one[k].dtype.kind == "f") for k in one
    )


@pytest.mark.parametrize("peer", PEERS)
def test_a_good_import_breaks_no_rule(peer, good):
    assert broken(peer, *good[peer]) == set()


@pytest.mark.parametrize(("peer", "name"), CASES)
def test_a_mutation_is_refused_mended_or_breaks_its_rule(peer, name, good, tmp_path):
    mutate, expected = OF[peer][name]
    try:
        found, instrument = imported(peer, mutate(PEERS[peer].read(), PEERS[peer]), tmp_path)
    except (ConfigurationError, MatrixError, ModelError) as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert REFUSED in expected
        assert "found" in refusal
        assert "\n" not in refusal
        return
    as_it_is = good[peer][0]
    if same(found.arrays, as_it_is.arrays) and found.tables == as_it_is.tables:
        assert MENDED in expected
        assert len(found.notes) > len(as_it_is.notes)
        return
    assert broken(peer, found, instrument) & expected


def axes_apart(one, other):
    """How far two registrations are apart, whichever way round sensor and drawing are together:
    the sizes of both shifts, rotation up to quarters and its sign, magnification.
    """
    quarter = np.pi / 2
    turns = [
        (sign * one.rotation_rad - other.rotation_rad + quarter / 2) % quarter - quarter / 2
        for sign in (1, -1)
    ]
    shifts = (np.sort(np.abs(each.vector[:2])) for each in (one, other))
    return np.array(
        [
            *np.abs(np.subtract(*shifts)),
            min(np.abs(turns)),
            abs(one.magnification - other.magnification),
        ]
    )


@pytest.fixture(scope="module")
def true_fit(good):
    return {
        peer: fit_matrix(instrument, Reference(matrix=found.arrays["interaction_matrix"]))
        for peer, (found, instrument) in good.items()
    }


@pytest.mark.parametrize("peer", PEERS)
def test_a_fit_of_a_good_import_is_accepted(peer, true_fit):
    assert true_fit[peer].accepted, true_fit[peer].verdict


@pytest.mark.parametrize(("peer", "name"), FITTED)
def test_a_fit_of_a_mutation_is_refused_or_right_and_says_what_was_found(
    peer, name, true_fit, good, tmp_path
):
    mutate, expected = OF[peer][name]
    found, instrument = imported(peer, mutate(PEERS[peer].read(), PEERS[peer]), tmp_path)
    matrix = Reference(matrix=found.arrays["interaction_matrix"])
    try:
        fit = fit_matrix(instrument, matrix)
    except (MatrixError, ModelError) as error:
        refusal = str(error)
    else:
        refusal = "" if fit.accepted else fit.verdict
    if refusal:
        assert refusal.startswith("refused: ") or "expected" in refusal
        return
    true = true_fit[peer]
    assert (axes_apart(fit.alpha, true.alpha) < 3.0 * np.hypot(fit.sigma, true.sigma)).all()
    told = {one.key: one.found for one in fit.origins}
    before = {one.key: one.found for one in true.origins}
    turned = abs(fit.alpha.rotation_rad - true.alpha.rotation_rad) > np.pi / 4
    said = fit.remarks != true.remarks  # such as which columns have changed places
    assert told != before or turned or said or MENDED in expected
