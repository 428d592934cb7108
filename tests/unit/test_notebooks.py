"""The notebooks in examples/ run from top to bottom, in the folder of the sources, and say so.

Cells are plain Python, so they are executed here as a kernel would, without one.
"""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from tests.support.tutorial_blocks import missing_lines

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))


def cells_of(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(path):
    """Execute all cells in one namespace; return it."""
    names = {"__name__": "__main__"}
    for number, cell in enumerate(cells_of(path), start=1):
        exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), names)
    return names


FOUND = {
    "1": lambda names: names["residual"] < 1e-3,
    "2": lambda names: (
        names["fit"].accepted and abs(names["fit"].alpha.shift_x_subap + 0.31) < 0.02
    ),
    "3": lambda names: np.all(np.diff(names["sigma"][:, 0]) < 0),
    "4": lambda names: np.all(
        np.abs(names["error"]) < 4.0 * names["track"].entries[-1].filtered_sigma
    ),
    "6": lambda names: (
        names["breaks_at"]["rotation, deg", 90] < 0.6 * names["breaks_at"]["rotation, deg", 30]
        and names["agreement"] < 0.1
    ),
}
"""What each comes to."""


@pytest.fixture(autouse=True)
def _as_a_reader_would(monkeypatch):
    pytest.importorskip("matplotlib").use("Agg")
    monkeypatch.chdir(ROOT)


def test_each_is_numbered():
    assert [path.stem[0] for path in NOTEBOOKS] == list("123456")


@pytest.mark.parametrize(
    "path", [path for path in NOTEBOOKS if path.stem[0] in FOUND], ids=lambda path: path.stem
)
def test_it_runs_from_top_to_bottom_and_prints_what_it_is_kept_with(path, capsys):
    names = run(path)
    assert FOUND[path.stem[0]](names)
    kept = [
        line for cell in cells_of(path) for one in cell["outputs"] for line in one.get("text", ())
    ]
    assert missing_lines("".join(kept), capsys.readouterr().out) == []


def test_one_that_asks_a_service_says_where_there_is_none(monkeypatch):
    from pyrcal.client.rest import UnreachableError

    monkeypatch.setenv("PYRCAL_URL", "http://127.0.0.1:9")
    with pytest.raises(UnreachableError, match=r"127\.0\.0\.1:9"):
        run(NOTEBOOKS[4])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_kept_with_what_it_shows(path):
    """The manual shows these outputs: jupyter nbconvert --execute --inplace writes them."""
    outputs = [one for cell in cells_of(path) for one in cell["outputs"]]
    assert outputs
    assert not [one for one in outputs if one["output_type"] == "error"]
    assert os.access(path, os.R_OK)
