from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from studies.heritier2018.crew import Progress, carry_out
from studies.heritier2018.store import Record, Store, Task

DONE: list[str] = []


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    name: str
    after: tuple[Step, ...] = ()
    cost_s: float = 1.0
    fails: bool = False

    @property
    def label(self) -> str:
        return self.name

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


def test_a_second_run_does_only_what_the_first_did_not_get_to(tmp_path: Path) -> None:
    base = Step(name="base")
    with pytest.raises(ValueError, match="breaks"):
        run((Step(name="breaks", after=(base,), fails=True),), tmp_path)
    DONE.clear()
    run((Step(name="holds", after=(base,)),), tmp_path)
    assert DONE == ["holds"]


def test_time_left_goes_by_cost_not_by_number_of_steps() -> None:
    stream = io.StringIO()
    progress = Progress(total_s=100.0, n_steps=11, stream=stream)
    progress._started -= 10.0
    for _ in range(10):
        progress.step(Step(name="cheap", cost_s=1.0))
    assert progress.left_s() == pytest.approx(90.0, rel=0.05)
    assert "10%" in progress.line("x").replace(" ", "")
    assert "10/11" in progress.line("x")


def test_where_it_cannot_be_redrawn_the_line_is_not_repeated_for_every_step() -> None:
    stream = io.StringIO()
    progress = Progress(total_s=100.0, n_steps=100, stream=stream)
    for _ in range(100):
        progress.step(Step(name="cheap"))
    assert len(stream.getvalue().splitlines()) == 2
    assert "100/100" in stream.getvalue()
