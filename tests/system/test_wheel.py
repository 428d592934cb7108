"""What ``pip install`` of a clean checkout brings: the program, and the manual that it shows."""

import os
import shutil
import subprocess
import sys
import zipfile

import pytest

from tests.support.night import ROOT
from tests.support.pace import patience

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of what git has, and of nothing that ``make`` has built beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in listed.stdout.splitlines():
        if not name.startswith("tests/") and (ROOT / name).is_file():
            (folder / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / "checkout" / name)
    words = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "pip", *words, str(folder / "checkout")],
        capture_output=True,
        text=True,
        timeout=patience(240.0),
        check=False,
        env={**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1", "PYRCAL_COMMIT": "0123abcd"},
    )
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as file:
        yield file


def test_a_wheel_has_the_manual_inside(wheel):
    names = set(wheel.namelist())
    docs = ROOT / "docs"
    pages = [path.relative_to(docs).with_suffix(".html") for path in docs.rglob("*.md")]
    pages = [page for page in pages if page.parts[0] != "paper"]  # none of the manual's
    assert {f"service/web/manual/{page.as_posix()}" for page in pages} <= names
    assert "service/web/manual/searchindex.js" in names
    assert any(name.endswith("tracking.png") for name in names)


def test_a_wheel_has_what_the_program_reads_besides_its_code(wheel):
    expected = [
        *(ROOT / "service" / "instrument" / "packaged").glob("*.toml"),
        *(ROOT / "service" / "web" / "dashboard").iterdir(),
        *(ROOT / "pyrcal" / "samples" / "data").iterdir(),
        ROOT / "service" / "commands.toml",
        ROOT / "service" / "records" / "alarms.toml",
        ROOT / "service" / "web" / "openapi.json",
    ]
    names = set(wheel.namelist())
    assert {str(path.relative_to(ROOT)) for path in expected if path.is_file()} <= names


def test_a_wheel_names_the_commit_that_it_was_built_from(wheel):
    assert wheel.read("service/commit.txt").decode().strip() == "0123abcd"


def test_a_wheel_has_the_demo_and_no_studies(wheel):
    folders = {name.partition("/")[0] for name in wheel.namelist()}
    assert {"service", "pyrcal", "sim_rtc", "check_rtc", "cacao_bridge"} <= folders
    assert "pyrcal_studies" not in folders
    assert "pyrcal/demo/__main__.py" in wheel.namelist()


def test_the_default_installation_reads_fits(wheel):
    (about,) = [name for name in wheel.namelist() if name.endswith("/METADATA")]
    needed = wheel.read(about).decode().splitlines()
    assert any(line.startswith("Requires-Dist: astropy") and "extra" not in line for line in needed)
