"""Events as they are kept, and nights that are told again."""

import numpy as np
import pytest

from pyrcal_studies.campaign.golden import (
    INSTRUMENT,
    Teller,
    decoded,
    encoded,
    first_difference,
    nights_in,
    read,
    written,
)
from service.records import commands as cmd
from service.records import events as ev
from service.records.estimates import RandomEstimate
from service.records.products import ModeSet
from service.records.state import Mode
from service.wire import DitherKind
from tests.support.situations import (
    ALPHA,
    POLICY,
    START_NS,
    estimate,
    foreign,
    record,
    rtc,
    verdict,
)
from tests.support.states import tracker_state

EVENTS = [
    ev.Tick(),
    rtc(cm_id=None),
    cmd.SetMode(mode=Mode.HOLD),
    cmd.StartDither(modes=(3, 4), frequency_hz=(100.0, 120.5)),
    cmd.StartDither(kind=DitherKind.BINARY, modes=ModeSet.CONTROLLED),
    ev.WindowFitted(estimate=estimate(optical_gain=np.array([0.6 + 0.25j, 1 / 3 + 0j]))),
    ev.MatrixMade(record=record("cm-1"), wanted=False),
    ev.MatrixFetched(record=foreign()),
    ev.MarginJudged(id="cm-1", verdict=verdict(), alpha=ALPHA),
    ev.JobFailed(effect=ev.MakeMatrix(n_modes=3, why="so", fewer=(2, 1)), text="no"),
]


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: type(event).__name__)
def test_an_event_comes_back_as_it_was(event):
    again = decoded(ev.Event, encoded(event))
    assert type(again) is type(event)
    assert encoded(again) == encoded(event)


def test_arrays_come_back_to_the_last_bit():
    values = np.random.default_rng(1).standard_normal((3, 4)) + 1j / 3
    again = decoded(np.ndarray, encoded(values))
    assert again.dtype == values.dtype
    np.testing.assert_array_equal(again, values)


def test_what_cannot_be_written_is_refused():
    with pytest.raises(TypeError, match="found set"):
        encoded({1})


def test_a_record_of_another_class_is_refused():
    with pytest.raises(TypeError, match="SetMode"):
        decoded(RandomEstimate, encoded(cmd.SetMode(mode=Mode.AUTO)))


def test_a_difference_says_where_it_is():
    found = {"effects": [{"is": "MakeMatrix", "n_modes": 3}]}
    expected = {"effects": [{"is": "MakeMatrix", "n_modes": 4}]}
    assert first_difference(found, expected) == "effects[0].n_modes: found 3; expected 4"
    assert first_difference(found, found) is None
    assert "found None" in first_difference({}, expected)


def test_numbers_may_differ_as_much_as_processors_do():
    assert first_difference([1.0, float("nan")], [1.0 + 1e-12, float("nan")]) is None
    assert first_difference([1.0], [1.0 + 1e-6]) is not None


def test_the_same_entries_make_the_same_file(tmp_path):
    teller = Teller(tracker_state(system="flao", mode=Mode.AUTO), POLICY)
    for event in (ev.SessionStarted(session="s1"), rtc(), ev.Tick()):
        teller.tell(event, START_NS)
    for name in ("one.jsonl.xz", INSTRUMENT):
        written(teller.entries, tmp_path / name)
    assert read(tmp_path / "one.jsonl.xz") == teller.entries
    assert nights_in(tmp_path) == [tmp_path / "one.jsonl.xz"]
    written(teller.entries, tmp_path / "two.jsonl.xz")
    one, two = nights_in(tmp_path)
    assert one.read_bytes() == two.read_bytes()
