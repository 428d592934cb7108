from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_rehearsal_of_the_paper_writes_its_page_and_repeats_no_step(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    command = [
        sys.executable,
        "-m",
        "pyrcal_studies.heritier2018",
        "--quick",
        "--output",
        str(tmp_path),
    ]
    first = subprocess.run(command, capture_output=True, text=True, check=True)
    page = Path(first.stdout.strip())
    assert "100%" in first.stderr
    text = page.read_text(encoding="utf-8")
    assert "rehearsal" in text
    assert " nan" not in text
    assert len(list((tmp_path / "heritier2018").glob("figure*.png"))) == 12
    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert again.stderr == ""
