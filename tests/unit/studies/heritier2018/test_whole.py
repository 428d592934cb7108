"""The whole study on the small telescope: every step runs, and the page and pictures are made."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pyrcal_studies.heritier2018 import figures, page, plan
from pyrcal_studies.heritier2018.store import Store, in_order

TINY = replace(
    plan.QUICK, influence_frames=20, closed_frames=20, ramp_frames=20, modes_every=2, every=3
)


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.usefixtures("small_telescope")
def test_a_run_ends_in_a_page_and_twelve_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    for name, value in (("N_MEASURED", 24), ("N_MORE", 32), ("N_BASIS", 40)):
        monkeypatch.setattr(plan, name, value)
    monkeypatch.setattr(plan, "INFLUENCE_MODES", (24, 40))
    monkeypatch.setattr(plan, "CAPTURE_MODES_EVERY", 4)
    store = Store(tmp_path)
    for task in in_order(plan.every_task(TINY)):
        if not store.has(task):
            store.write(task, task.compute(store))
    figures.write_all(TINY, store, tmp_path / page.PICTURES)
    pictures = sorted(path.name for path in (tmp_path / page.PICTURES).iterdir())
    assert pictures == [f"figure{number:02d}.png" for number in range(3, 15)]
    text = page.write(TINY, store, 1.0)
    assert text.count("![Figure") == 12
    assert "rehearsal" in text
    assert len(re.findall(r"^\| Equation \d+ ", text, re.MULTILINE)) == 10
    assert len(re.findall(r"^\| \[Figure \d+\]", text, re.MULTILINE)) == 14
