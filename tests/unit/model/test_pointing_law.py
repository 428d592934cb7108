"""Laws of pointing: what is worked out, and what is refused."""

import numpy as np
import pytest

from service.errors import ModelError
from service.model.misregistration import Misregistration
from service.model.pointing_law import PointingLaw, Term

TOLD = {"azimuth": 210.0, "elevation": 60.0, "derotator": -4.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("azimuth - 12.984 + 0.60", 197.616),
        ("-azimuth/2 + elevation", -45.0),
        ("0.5*derotator", -2.0),
        ("sin(elevation)**2 + cos(elevation)**2", 1.0),
        ("abs(derotator) * sqrt(4)", 8.0),
        ("1e-3 * (elevation - 60)", 0.0),
        ("3", 3.0),
    ],
)
def test_an_expression_is_arithmetic_in_degrees(text, expected):
    assert Term(text).value(TOLD) == pytest.approx(expected)


def test_a_term_says_what_must_be_told():
    assert Term("sin(azimuth) + derotator").names == {"azimuth", "derotator"}
    law = PointingLaw(rotation_deg=Term("azimuth"), shift_x_subap=Term("elevation"))
    assert law.names == {"azimuth", "elevation"}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("__import__('os').system('x')", "found call in"),
        ("open('x')", "found open() in"),
        ("azimuth.real", "found attribute in"),
        ("[azimuth for azimuth in ()]", "found listcomp in"),
        ("lambda: 0", "found lambda in"),
        ("azimuth if elevation else 0", "found ifexp in"),
        ("azimuth == 3", "found compare in"),
        ("'a' * 9", "found 'a' in"),
        ("True", "found True in"),
        ("1j", "found 1j in"),
        ("sin(azimuth, elevation)", "found call in"),
        ("sin(x=azimuth)", "found call in"),
        ("azimuth[0]", "found subscript in"),
        ("azimuth // 2", "found floordiv in"),
        ("(azimuth := 3)", "found namedexpr in"),
        ("azimuth -", "expected an expression of"),
        ("", "expected an expression of"),
        ("a\nb", "expected an expression of"),
        ("(" * 150 + ")" * 150, "found 300 letters, expected at most 200"),
    ],
)
def test_nothing_but_arithmetic_is_an_expression(text, found):
    with pytest.raises(ModelError) as refused:
        Term(text)
    assert found in str(refused.value)


@pytest.mark.parametrize("text", ["1/(elevation - 60)", "sqrt(derotator)", "10**400", "(-1)**0.5"])
def test_what_is_no_number_now_is_said(text):
    with pytest.raises(ModelError, match="is no number now"):
        Term(text).value(TOLD)


def test_a_table_is_straight_between_its_places_and_holds_beyond_them():
    term = Term("elevation", (20.0, 50.0, 80.0), (0.1, 0.0, -0.2))
    told = [term.value({"elevation": e}) for e in (0.0, 20.0, 35.0, 65.0, 80.0, 90.0)]
    assert told == pytest.approx([0.1, 0.1, 0.05, -0.1, -0.2, -0.2])


def test_a_table_with_a_period_repeats_itself():
    term = Term("angle", (-180.0, 0.0, 90.0), (0.1, 0.3, 0.2), 360.0)
    told = [term.value({"angle": angle}) for angle in (-270.0, 0.0, 45.0, 135.0, 180.0, 405.0)]
    assert told == pytest.approx([0.2, 0.3, 0.25, 0.15, 0.1, 0.25])
    with pytest.raises(ModelError, match="at least the table's length"):
        Term("angle", (0.0, 400.0), (0.0, 1.0), 360.0)


@pytest.mark.parametrize(
    ("at", "values", "period", "step"),
    [
        ((-180.0, 0.0, 180.0), (-0.12, 0.0, 0.12), 360.0, -0.24),
        ((-180.0, 0.0, 180.0), (-0.12, 0.0, 0.12), None, -0.24),
        ((-180.0, 0.0, 180.0), (0.1, 0.0, 0.1), 360.0, 0.0),
        ((-180.0, 0.0, 170.0), (-0.12, 0.0, 0.12), 360.0, 0.0),
        ((20.0, 80.0), (0.1, -0.1), None, 0.0),
        ((0.0, 180.0), (0.0, 0.3), 180.0, -0.3),
    ],
)
def test_the_step_of_a_table_where_it_begins_again(at, values, period, step):
    assert Term("angle", at, values, period).closing_step == pytest.approx(step)


@pytest.mark.parametrize(
    ("at", "values", "expected"),
    [
        ((1.0, 2.0), (1.0,), "found 2 places and 1 values"),
        ((1.0,), (1.0,), "two at least"),
        ((2.0, 1.0), (1.0, 2.0), "expected rising ones"),
    ],
)
def test_a_table_that_is_none_is_refused(at, values, expected):
    with pytest.raises(ModelError, match=expected):
        Term("elevation", at, values)


def test_a_law_is_a_registration_and_what_it_leaves_out_is_nominal():
    law = PointingLaw(rotation_deg=Term("azimuth - 12.984"), magnification=Term("1.028"))
    found = law.at(TOLD)
    assert found == Misregistration(
        rotation_rad=float(np.deg2rad(210.0 - 12.984)), magnification=1.028
    )
    with pytest.raises(ModelError, match="magnification > 0"):
        PointingLaw(magnification=Term("-1")).at(TOLD)


@pytest.mark.parametrize(
    ("term", "step"),
    [
        (Term("0.0008 * azimuth"), 0.288),
        (Term("azimuth", (0.0, 360.0), (0.1, 0.3)), 0.2),
        (Term("azimuth", (-180.0, 180.0), (0.1, 0.1)), 0.0),
        (Term("azimuth", (-180.0, 180.0), (0.1, 0.3), 360.0), 0.2),
        (Term("azimuth", (-180.0, 90.0), (0.1, 0.3), 360.0), 0.0),
        (Term("0.1 * sin(azimuth) + elevation / 100"), 0.0),
        (Term("azimuth - 12.98"), 360.0),
        (Term("0.1 * sin(azimuth / 2)"), 0.2),
        (Term("elevation"), 0.0),
        (Term("0.001 * azimuth + derotator"), 0.36),
    ],
)
def test_the_step_of_a_term_after_a_turn_of_azimuth(term, step):
    assert abs(term.north_step()) == pytest.approx(step, abs=1e-12)
