from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_rehearsal_of_the_paper_writes_a_report_and_does_nothing_twice(tmp_path: Path) -> None:
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
    report = Path(first.stdout.strip())
    assert "100%" in first.stderr
    text = report.read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"#][^"]{0,20})', text)
    assert len(sources) >= 12
    assert all(source.startswith("data:image/png") for source in sources)
    assert "nan" not in re.sub(r'src="[^"]*"', "", text).lower().split()
    again = subprocess.run(command, capture_output=True, text=True, check=True)
    assert again.stderr == ""
