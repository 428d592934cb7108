from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018.store import Record, Store, Task, carry_out, processor_minutes

DONE: list[str] = []


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    name: str
    after: tuple[Step, ...] = ()
    fails: bool = False

    @property
    def needs(self) -> tuple[Task, ...]:
        return self.after

    def compute(self, store: Store) -> Record:
        assert all(store.has(step) for step in self.after)
        if self.fails:
            raise ValueError(self.name)
        DONE.append(self.name)
        return {"x": np.zeros(1)}


@pytest.fixture(autouse=True)
def _forget() -> None:
    DONE.clear()


def run(tasks: tuple[Step, ...], folder: Path) -> None:
    with ThreadPoolExecutor(2) as threads:
        carry_out(tasks, Store(folder), n_workers=2, executor=threads)


def test_every_step_is_done_once_and_after_those_it_needs(tmp_path: Path) -> None:
    base = Step(name="base")
    tops = tuple(Step(name=f"top {k}", after=(base,)) for k in range(5))
    run(tops, tmp_path)
    assert DONE[0] == "base"
    assert sorted(DONE) == sorted(["base", *(top.name for top in tops)])


def test_the_processor_time_of_every_step_is_kept(tmp_path: Path) -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Busy(Step):
        def compute(self, store: Store) -> Record:
            end = time.process_time() + 0.05
            while time.process_time() < end:
                pass
            return {"x": np.zeros(1)}

    steps = (Busy(name="one"), Busy(name="two"))
    run(steps, tmp_path)
    assert 0.09 / 60.0 < processor_minutes(steps, Store(tmp_path)) < 5.0 / 60.0


def test_a_second_run_does_only_what_the_first_did_not_get_to(tmp_path: Path) -> None:
    base = Step(name="base")
    with pytest.raises(ValueError, match="breaks"):
        run((Step(name="breaks", after=(base,), fails=True),), tmp_path)
    DONE.clear()
    run((Step(name="holds", after=(base,)),), tmp_path)
    assert DONE == ["holds"]


def test_the_progress_is_not_shown_for_every_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tuple(Step(name=f"cheap {k}") for k in range(20)), tmp_path)
    shown = capsys.readouterr().err.splitlines()
    assert len(shown) == 2
    assert "20 of 20" in shown[-1]
