from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from pyrcal_studies.heritier2018.store import Record, Store, Task, in_order


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubled:
    """A number, or twice the result of another task."""

    value: float = 1.0
    source: Doubled | None = None

    @property
    def needs(self) -> tuple[Task, ...]:
        return () if self.source is None else (self.source,)

    def compute(self, store: Store) -> Record:
        found = self.value if self.source is None else store.read(self.source)["value"]
        return {"value": np.array(2 * found)}


def test_a_result_comes_back_as_it_was_written(tmp_path: Path) -> None:
    store, task = Store(tmp_path / "new"), Doubled(value=3.0)
    assert not store.has(task)
    store.write(task, task.compute(store))
    assert store.has(task)
    assert store.read(task)["value"] == 6.0


def test_another_parameter_anywhere_below_is_another_result() -> None:
    store = Store(Path("anywhere"))
    task = Doubled(source=Doubled(value=3.0))
    deeper = replace(task, source=Doubled(value=np.nextafter(3.0, 4.0)))
    assert store.path(task) == store.path(Doubled(source=Doubled(value=3.0)))
    assert store.path(task) != store.path(deeper)


def test_a_run_cut_off_while_writing_leaves_nothing_that_counts(tmp_path: Path) -> None:
    class Cut:
        def __array__(self, *_: object, **__: object) -> None:
            raise KeyboardInterrupt

    store, task = Store(tmp_path), Doubled()
    with pytest.raises(KeyboardInterrupt):
        store.write(task, {"value": np.ones(3), "cut": Cut()})  # type: ignore[dict-item]
    assert not store.has(task)


def test_tasks_come_after_those_they_need_and_only_once() -> None:
    first = Doubled(value=1.0)
    second, third = Doubled(source=first), Doubled(value=2.0, source=first)
    assert in_order((third, second, third)) == (first, third, second)
