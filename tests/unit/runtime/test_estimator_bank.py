"""The bank obeys what estimators declare, whoever they are."""

from dataclasses import dataclass, replace

import pytest
from typing_extensions import override

from service.estimation.estimator import UNMARKED, Change, LoopContext, Mark, Streaming
from service.estimation.health import LoopHealth
from service.records.alarms import ALARMS
from service.runtime.estimator_bank import EstimatorBank, process_block, with_dither, with_rtc
from service.runtime.registry import Entry
from tests.support.streams import DESCRIPTION, DITHER, RTC, WINDOW_S, block


@dataclass(frozen=True, slots=True, kw_only=True)
class Counter(Streaming):
    """Counts blocks and how often it has begun anew."""

    resets = Change.LOOP | Change.STANDSTILL
    unless = Mark.ABSURD
    only_closed = True

    n_blocks: int = 0
    n_begun: int = 0

    @override
    def restart(self, loop, why):
        return Counter(n_begun=self.n_begun + 1)

    @override
    def update(self, frames):
        return replace(self, n_blocks=self.n_blocks + 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Marker(Streaming):
    """Says of every block what it was made to say."""

    mark: Mark = UNMARKED

    @override
    def update(self, frames):
        return self

    @property
    @override
    def marks(self):
        return self.mark


def bank_of(*members):
    entries = tuple(Entry(type(member)) for member in members)
    loop = LoopContext(description=DESCRIPTION)
    return EstimatorBank(loop=loop, entries=entries, members=members)


def test_one_begins_anew_for_what_it_declares_and_for_nothing_else():
    bank = with_rtc(bank_of(Counter()), RTC)
    assert bank[Counter].n_begun == 1
    bank, _ = process_block(bank, block(0))
    bank = with_dither(with_rtc(bank, replace(RTC, seq=99, magnitude=9.0)), DITHER, WINDOW_S)
    bank, _ = process_block(bank, block(100, cm_id="cm-1"))
    assert bank[Counter] == Counter(n_blocks=2, n_begun=1)
    assert with_rtc(bank, replace(RTC, leak=0.9))[Counter] == Counter(n_begun=2)


@pytest.mark.parametrize(
    ("mark", "expected"),
    [
        (UNMARKED, Counter(n_blocks=1, n_begun=1)),
        (Mark.WINDOWS, Counter(n_blocks=1, n_begun=1)),
        (Mark.ABSURD, Counter(n_begun=1)),
        (Mark.STANDS, Counter(n_blocks=1, n_begun=2)),
    ],
)
def test_what_one_says_of_a_block_is_heard_by_those_after_it(mark, expected):
    bank, _ = process_block(with_rtc(bank_of(Marker(mark=mark), Counter()), RTC), block(0))
    assert bank[Counter] == expected


def test_those_before_it_do_not_hear_it():
    marks = Mark.ABSURD | Mark.STANDS
    bank, _ = process_block(with_rtc(bank_of(Counter(), Marker(mark=marks)), RTC), block(0))
    assert bank[Counter] == Counter(n_blocks=1, n_begun=1)


def test_blocks_of_an_open_loop_are_not_for_one_of_closed_loops():
    opened = with_rtc(bank_of(Counter()), replace(RTC, loop="open"))
    assert process_block(opened, block(0))[0][Counter].n_blocks == 0


def test_without_an_rtc_only_those_begin_anew_that_declare_it():
    bank, _ = process_block(with_rtc(bank_of(Counter()), RTC), block(0))
    assert with_rtc(bank, None)[Counter] == bank[Counter]


def test_a_loop_that_ran_away_is_forgotten_with_its_rtc():
    ran_away = LoopHealth(ratio=50.0, diverging=True, absurd=True)
    bank = with_rtc(bank_of(LoopHealth()), RTC)
    bank = replace(bank, members=(ran_away,))
    assert with_rtc(bank, RTC)[LoopHealth] == ran_away
    assert with_rtc(bank, None)[LoopHealth] == LoopHealth()


def test_each_detector_has_as_many_conditions_as_alarms():
    bank = EstimatorBank.of(DESCRIPTION)
    for entry, member in zip(bank.entries, bank.members, strict=True):
        names = [name for name, text, over in entry.conditions(member) if over and text is None]
        assert names == list(entry.alarms)
        assert set(names) <= ALARMS.keys()
