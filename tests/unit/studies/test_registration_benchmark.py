"""The benchmark of registration: its files are complete, and the page has today's results."""

import json
import re

import numpy as np
import pytest

from benchmarks import registration
from tests.support.repository import ROOT

TRUTH = json.loads((registration.FOLDER / "truth.json").read_text("utf-8"))
PAGE = (ROOT / "docs" / "results" / "registration.md").read_text("utf-8")


def test_every_matrix_has_its_files_and_a_row():
    assert list(TRUTH) == list(registration.CASES)
    assert len(TRUTH) == 20
    for name in TRUTH:
        assert (registration.FOLDER / f"{name}.h5").stat().st_size < 100_000
        assert (registration.FOLDER / f"{name}.toml").is_file()
    assert re.findall(r"^\| `(\w[\w-]+)` \|", PAGE, re.M) == list(TRUTH)


@pytest.mark.parametrize("name", ["oopao-far-1009", "hcipy-1003", "specula-noisy-1013"])
def test_the_fit_of_the_files_is_the_one_on_the_page(name, monkeypatch):
    truth = json.dumps({name: TRUTH[name]})
    monkeypatch.setattr(registration, "read_truth", lambda: json.loads(truth))
    (row,) = registration.scored()
    assert row["accepted"]
    assert np.abs(row["error"] / row["sigma"]).max() < 3.0
    (printed,) = re.findall(rf"^\| `{name}` \| ([^|]+) \|", PAGE, re.M)
    found = np.array([float(word) for word in printed.split(", ")])
    np.testing.assert_allclose(row["error"], found, atol=0.2 * row["sigma"].max())
