"""What outlives a service of its tracking: one file, whole or put aside."""

import hashlib
import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from service.archive import Archive
from service.archive.serialisation import TrackingFile
from service.errors import ArchiveError
from service.tracking import commands as cmd
from service.tracking.mode_limits import ModeAnswer, ModeProof
from service.tracking.registration import Registration
from service.tracking.resume import saved_of
from service.tracking.state import Mode, Orders
from service.wire import Pointing
from tests.states import changed
from tests.unit.tracking.operations.test_acquisition import Acquiring
from tests.unit.tracking.situations import START_NS, Story, moved
from tests.unit.tracking.test_watchdog import learnt, watch

DATA = Path(__file__).parents[1] / "data" / "archive"


@pytest.fixture(scope="module")
def saved():
    """What a night with windows, looks and a known pointing has left."""
    story = Story(Mode.AUTO).meet()
    story.state = changed(story.state, pointing=Pointing(elevation_deg=61.0, azimuth_deg=120.0))
    story.see(n_windows=3, modes=(501, 509, 517, 525), gain_sigma=np.full(4, 0.01))
    learnt(story, n_looks=3)
    watch(story, moved(shift_x_subap=0.06))
    return saved_of(story.state, story.now_ns)


@pytest.fixture
def file(tmp_path):
    return TrackingFile(tmp_path / "tracking.json")


def same(one, other):
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if hasattr(one, "__dataclass_fields__"):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def test_there_is_nothing_before_the_first_night(file):
    assert file.read() is None


def test_what_is_read_is_what_was_written_but_for_what_depends_on_the_time(file, saved):
    file.write(saved)
    found = file.read()
    fresh = {
        f.name: f.default for f in fields(Registration) if f.name in {"validity", "suspected_jump"}
    }
    expected = replace(saved, registration=replace(saved.registration, grown=np.zeros(4), **fresh))
    for f in fields(Registration):
        left, right = getattr(found.registration, f.name), getattr(expected.registration, f.name)
        assert same(left, right), f.name
    assert same(found, expected)
    assert found.registration.biases != ()
    assert len(found.registration.optical_gains) == 4


def test_what_modes_have_shown_is_read_as_it_was_written(file, saved):
    proof = ModeProof(
        proven=frozenset(range(400)),
        suspected=frozenset({430}),
        answers=(ModeAnswer(mode=430, gain=-0.6, like=77),),
        own_uneven="by the RTC's own matrix mode 3 2.1 times as strongly as its neighbours",
        own_response_ratio=0.7,
    )
    file.write(replace(saved, mode_proof=proof))
    assert file.read().mode_proof == proof


@pytest.fixture(scope="module")
def cut_off():
    """What a service has left that ended while its loop was open."""
    story = Acquiring()
    story.tell(cmd.Acquire())
    story.open()
    return saved_of(story.state, story.now_ns)


def test_an_acquisition_under_way_is_read_as_it_was_written(file, cut_off):
    file.write(cut_off)
    found = file.read()
    assert found.registration is None
    # who began it is known to that service alone
    assert cut_off.acquisition.cause
    assert same(found, replace(cut_off, acquisition=replace(cut_off.acquisition, cause="")))
    assert found.acquisition.found.gains == (0.4,) * 400 + (0.0,) * 194
    assert found.acquisition.interruption.session == "s2"
    assert found.acquisition.interruption.cause == "the service ended"


def test_that_an_operator_ended_one_is_read_as_it_was_written(file, cut_off):
    file.write(replace(cut_off, acquisition=replace(cut_off.acquisition, held_off=True)))
    assert file.read().acquisition.held_off is True


@pytest.mark.parametrize(
    "values",
    [
        {"stage": "lost"},
        {"attempt": "two"},
        {"found": {"gains": [0.4, None]}},
        {"interruption": {"doing": "coarse"}},
        {"shoe_size": 43},
    ],
)
def test_a_damaged_acquisition_is_no_acquisition(file, cut_off, tmp_path, values):
    file.write(cut_off)
    path = tmp_path / "tracking.json"
    found = content_of(path.read_text())
    found["acquisition"] |= values
    path.write_text(signed(found))
    with pytest.raises(ArchiveError, match="damaged"):
        file.read()


def content_of(text):
    """Return what a file says besides its checksum."""
    return {name: value for name, value in json.loads(text).items() if name != "sha256"}


def signed(values):
    """Return the text of a file whose checksum is right."""
    return json.dumps(values | {"sha256": hashlib.sha256(json.dumps(values).encode()).hexdigest()})


ORDERS = Orders(mode=Mode.HOLD, settings_mode=Mode.AUTO, dither_stopped=True)


def test_orders_are_read_as_they_were_given(file, saved):
    file.write(replace(saved, orders=ORDERS))
    assert file.read().orders == ORDERS
    assert file.read().orders.mode is Mode.HOLD


def test_orders_alone_are_worth_a_file(file, saved):
    file.write(replace(saved, registration=None, orders=ORDERS))
    found = file.read()
    assert (found.registration, found.orders) == (None, ORDERS)


@pytest.mark.parametrize(
    "values",
    [{"mode": "fast"}, {"mode": None}, {"dither_stopped": "no"}, {"shoe_size": 43}],
)
def test_damaged_orders_are_none(file, saved, tmp_path, values):
    file.write(replace(saved, orders=ORDERS))
    path = tmp_path / "tracking.json"
    found = content_of(path.read_text())
    found["orders"] |= values
    path.write_text(signed(found))
    with pytest.raises(ArchiveError, match="damaged, moved to"):
        file.read()


def test_the_newest_replaces_what_was_there(file, saved, tmp_path):
    file.write(saved)
    file.write(replace(saved, saved_ns_utc=START_NS + 1))
    assert file.read().saved_ns_utc == START_NS + 1
    assert [path.name for path in tmp_path.iterdir()] == ["tracking.json"]


@pytest.mark.parametrize(("was", "became"), [('"alpha": [0', '"alpha": [1'), ("HOLD", "AUTO")])
def test_one_digit_or_word_that_has_changed_is_damage(file, saved, tmp_path, was, became):
    file.write(replace(saved, orders=ORDERS))
    path = tmp_path / "tracking.json"
    text = path.read_text()
    changed = re.sub(was.replace("[", "\\["), became, text, count=1, flags=re.IGNORECASE)
    assert changed != text
    path.write_text(changed)
    with pytest.raises(ArchiveError, match="found checksum"):
        file.read()


def altered(**values):
    def change(text):
        return signed({**content_of(text), **values})

    return change


def with_registration(**values):
    def change(text):
        found = content_of(text)
        found["registration"] |= values
        return signed(found)

    return change


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[]",
        altered(version=7),
        altered(registration=None),
        altered(shoe_size=43),
        with_registration(alpha=[0.1, 0.2, 0.3]),
        with_registration(alpha=[0.1, 0.2, float("nan"), 1.0]),
        with_registration(covariance=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()),
        with_registration(t_ns_utc="yesterday"),
        with_registration(optical_gains=[{"mode": 3}]),
    ],
)
def test_a_damaged_file_is_put_aside_and_the_next_can_be_written(file, saved, tmp_path, damage):
    file.write(saved)
    path = tmp_path / "tracking.json"
    path.write_text(damage(path.read_text()))
    with pytest.raises(ArchiveError, match="damaged, moved to"):
        file.read()
    assert sorted(found.name for found in tmp_path.iterdir()) == ["tracking.damaged"]
    assert file.read() is None
    file.write(saved)
    assert file.read() is not None


def test_a_disk_that_refuses_is_named(tmp_path, saved):
    with pytest.raises(ArchiveError, match="cannot be written"):
        TrackingFile(tmp_path / "nowhere" / "tracking.json").write(saved)


def test_it_lies_in_the_archives_directory(tmp_path, saved):
    with Archive(tmp_path) as archive:
        archive.open()
        archive.tracking.write(saved)
    assert (tmp_path / "tracking.json").exists()
