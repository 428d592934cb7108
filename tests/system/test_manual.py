"""The commands of the manual, run as somebody types them who has nothing else.

In an empty folder with the two files that the manual speaks of: ``bench.toml``, as it prints it,
and ``im.h5``, measured on the diffractive simulator with that file. Its ports are others', so each
program is told its own; nothing else is changed.
"""

import os
import shutil
import subprocess
import sys

import h5py
import pytest

from service.instrument import load_instrument
from service.model.misregistration import PARAMETERS, Misregistration
from tests.data.tiny.make import push_pull
from tests.system.night import ROOT, a_night, wait_for
from tests.system.pace import patience
from tests.unit.test_docs import PAGES, blocks_of, commands

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(300)]

ALPHA = dict(zip(PARAMETERS, (0.2, -0.1, 0.4, 1.003), strict=True))
ALONE = {"fit", "reconstruct", "key"}
"""Commands that work on files, need nothing that runs, and take seconds."""


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with what the manual takes for granted."""
    folder = tmp_path_factory.mktemp("desk")
    bench = next(  # the smallest one comes first, one with lenslets after it
        text
        for text, _ in blocks_of(ROOT / "docs" / "integrate" / "fitting.md", "toml")
        if text.startswith("[instrument]")
    )
    (folder / "bench.toml").write_text(bench, encoding="utf-8")
    instrument = load_instrument(folder / "bench.toml")
    alpha = Misregistration.from_boundary(ALPHA)
    matrix = push_pull(instrument, alpha, n_modes=60, noise=1e-4, seed=4)
    with h5py.File(folder / "im.h5", "w") as file:
        file["interaction_matrix"] = 2.0 * matrix  # the file says double_pass
    imported = folder / "bench"  # what pyrcal import writes, of another code's files
    imported.mkdir()
    shutil.copy(folder / "bench.toml", imported / "instrument.toml")
    shutil.copy(folder / "im.h5", imported / "matrix.h5")
    shutil.copytree(ROOT / "tests" / "data" / "tiny", folder / "tests" / "data" / "tiny")
    return folder


HOWTO = ROOT / "docs" / "operate" / "howto.md"

ASKED = {"status", "reconstructors", "export", "audit", "dither", "stop", "resume"}
"""Commands to a running service that end at once and leave the night as it was."""


def pyrcal(words, folder, data, **environment):
    return subprocess.run(
        [sys.executable, "-m", "pyrcal", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=patience(200.0),
        check=False,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "PYRCAL_SERVICE__DATA_DIR": str(data),
            **environment,
        },
    )


def typed(page):
    """Each command of ours in the blocks of a page that are run."""
    for text, why in blocks_of(page, "sh"):
        for program, *words in commands(text) if why is None else ():
            if program.removeprefix(".venv/bin/") == "pyrcal":
                yield words


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(words[0] in ALONE for words in typed(page))],
    ids=lambda page: page.stem,
)
def test_what_works_on_files_works_as_it_is_written(page, desk, tmp_path):
    for words in typed(page):
        if words[0] in ALONE and "flao-lbt" not in words:
            words = words[: words.index(">")] if ">" in words else words
            done = pyrcal(words, desk, tmp_path)
            assert done.returncode == 0, (words, done.stderr)


def test_the_bench_of_the_manual_is_fitted_where_it_was_measured(desk, tmp_path):
    done = pyrcal(["fit", "bench.toml", "im.h5", "--json"], desk, tmp_path)
    assert done.returncode == 0, done.stderr
    assert '"verdict": "accepted' in done.stdout


def asked_for_real(night, folder):
    """What docs/operate/operating.md types at a running service, in its order: each is answered."""
    done = []
    for words in typed(ROOT / "docs" / "operate" / "operating.md"):
        if words[0] in ASKED and not {"ID", "measurement", "recording"} & set(words):
            answer = pyrcal(words, folder, folder, PYRCAL_URL=f"http://127.0.0.1:{night.port}")
            told = {0, 1} if words[0] == "status" else {0}  # 1: there is an alarm
            assert answer.returncode in told, (words, answer.stdout, answer.stderr)
            done.append(words[0])
    assert set(done) == ASKED


def test_a_night_is_rehearsed_with_the_bench_of_the_manual(desk, tmp_path):
    """Run, sim and check-rtc of docs/operate/howto.md, each as it is written there."""
    written = [words for words in typed(HOWTO) if "bench.toml" in words]
    by_name = {name: [w for w in written if w[0] == name] for name in ("run", "sim", "check-rtc")}
    with a_night(tmp_path) as night:

        def start(words, *own):
            words = [str(desk / word) if word == "bench.toml" else word for word in words]
            return night.start(words[0], ["pyrcal", *words, *own])

        own = ["--listen", night.zenoh, "--port", str(night.port)]
        own += ["--data-dir", str(night.directory / "data")]
        service = start(by_name["run"][0], *own)
        wait_for(lambda: night.ready(service), 60.0, lambda: service.log)
        start(by_name["sim"][0], "--connect", night.zenoh, "--seed", "3")
        known = wait_for(lambda: night.state["registration"], 60.0, lambda: night.state)
        assert max(known["sigma"].values()) < 0.2
        wait_for(lambda: night.ids("proposed"), 60.0, lambda: night.state)
        asked_for_real(night, tmp_path)
        passive = start(["check-rtc", "--connect", night.zenoh, "--passive", "--seconds", "3"])
        assert passive.ended(60.0) == 0, passive.log
        assert "the RTC there is that of system bench" in passive.log
        os.kill(service.popen.pid, 2)
        service.ended(20.0)
        kept = [words for words in typed(HOWTO) if words[0] == "archive"]
        for words in kept:
            done = pyrcal(words, desk, night.directory / "data")
            assert done.returncode == 0, (words, done.stderr)
        assert [words[1] for words in kept] == ["list", "verify", "prune"]
        for words in by_name["check-rtc"]:
            check = start(words, "--listen", night.zenoh, "--seconds", "3")
            assert check.ended(90.0) == 0, check.log
        assert len(by_name["check-rtc"]) == 2
