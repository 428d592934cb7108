"""The pages of the manual, from top to bottom, each in a folder of its own.

Every block of commands or Python that is not marked is run as it is written, and prints the block
of text after it. A page's folder holds what the page says that its reader has: ``bench.toml`` as
the manual prints it, a matrix ``im.h5`` measured on the diffractive simulator with that file, and
so on; a page without an entry in :data:`PREPARED` starts in an empty folder.
"""

import json
import os
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
from astropy.io import fits

from pyrcal.samples.__main__ import main as write_sample
from service.instrument import load_instrument
from service.model.interaction import RtcInteractionModel
from service.model.misregistration import PARAMETERS, Misregistration
from service.model.modes import modal_basis
from tests.data.tiny.make import push_pull
from tests.support import systems
from tests.support.checker import write_plant
from tests.support.manual import PAGES, blocks_of, commands
from tests.support.night import INSTRUMENT, ROOT, a_night, wait_for
from tests.support.pace import patience
from tests.support.reader import Reader
from tests.support.tutorial_blocks import steps
from tests.system import milk_loop

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(600)]

DOCS = ROOT / "docs"
PYRTC_BENCH = """
[instrument]
name = "pyrtc"
diameter_m = 8.0
obscuration_ratio = 0.112
stop = "telescope"
[wfs]
kind = "pyramid"
n_subapertures = 20
pupil_separation_subap = 24
wavelength_m = 640e-9
modulation_lambda_over_d = 5.0
[mirror]
layout = "grid"
n_across = 17
pitch_m = 0.5
diameter_m = 8.7
influence = "gaussian"
coupling = 0.35
[modes]
n_modes = 100
"""

ALPHA = dict(zip(PARAMETERS, (0.2, -0.1, 0.4, 1.003), strict=True))


def write_bench(folder, _):
    """``bench.toml`` and ``im.h5``, and the same as ``pyrcal import`` writes them."""
    bench = next(  # the smallest one comes first, one with lenslets after it
        text
        for text, _ in blocks_of(DOCS / "howto" / "fitting.md", "toml")
        if text.startswith("[instrument]")
    )
    (folder / "bench.toml").write_text(bench, encoding="utf-8")
    instrument = load_instrument(folder / "bench.toml")
    alpha = Misregistration.from_boundary(ALPHA)
    matrix = push_pull(instrument, alpha, n_modes=60, noise=1e-4, seed=4)
    with h5py.File(folder / "im.h5", "w") as file:
        file["interaction_matrix"] = 2.0 * matrix  # the file says double_pass
    np.save(folder / "matrix.npy", 2.0 * matrix)
    imported = folder / "bench"
    imported.mkdir()
    measured = f"{bench}\n[modes]\nn_modes = 60\n"
    (imported / "instrument.toml").write_text(measured, encoding="utf-8")
    shutil.copy(folder / "im.h5", imported / "matrix.h5")


def write_bench_and_serve(folder, reader):
    """The files of a bench, and a service that runs with them."""
    write_bench(folder, reader)
    reader.start(["run", "--instrument", "bench.toml", "--mode", "hold"])


def track_a_night(folder, reader, mode="hold", modes=None):
    """Run a service and a simulated RTC of the bench; return once α is known."""
    write_bench(folder, reader)
    reader.start(["run", "--instrument", "bench.toml", "--mode", mode])
    reader.start(["sim", "--instrument", "bench.toml", *(modes or ())])
    wait_for(lambda: reader.night.state["registration"], 60.0, lambda: reader.night.state)


def write_archive(folder, reader):
    """An archive ``var`` with a reconstructor of the service that is in use."""
    track_a_night(folder, reader, "auto", ["--n-controlled", "40"])
    wait_for(reader.night.n_modes_in_use, 60.0, lambda: reader.night.state)
    (folder / "var").symlink_to(folder / "data")


def write_recording(folder, reader):
    """``night.h5``, 20 s of a loop with the service's dither, and a recorder's own file."""
    track_a_night(folder, reader, "hold", ["--record", "night.h5", "--seconds", "30"])
    reader.beside.pop("sim").ended(60.0)
    reader.end("run")


def write_imports(folder, _):
    """Files of each code that ``pyrcal import`` reads, by the names on the page."""
    write_sample(["cacao", str(folder / "conf")])
    write_sample(["papyrus", str(folder / "data")])
    write_sample(["specula", str(folder)])
    for name, other in (("im", "im"), ("pup", "pupdata"), ("ifunc", "ifunc")):
        (folder / f"specula-{name}.fits").rename(folder / f"{other}.fits")
    systems.written(folder)  # ground.toml: a Shack-Hartmann of 10 subapertures
    instrument = load_instrument(folder / "ground.toml")
    model = RtcInteractionModel(instrument, modal_basis(instrument))
    matrix = np.asarray(model.interaction_matrix(Misregistration.from_boundary(ALPHA)))
    positions = instrument.analytic_mirror.positions_m
    arrays = {"D": matrix * 1e-6, "valid": model.valid, "positions": positions}
    np.savez(folder / "bench.npz", **arrays)


def write_pyrtc(folder, _):
    """A matrix and a mask as pyRTC saves them, and the arrays of its mirror."""
    (folder / "told.toml").write_text(PYRTC_BENCH, encoding="utf-8")
    instrument = load_instrument(folder / "told.toml")
    basis = modal_basis(instrument)
    model = RtcInteractionModel(instrument, basis)
    matrix = np.asarray(model.interaction_matrix(Misregistration.from_boundary(ALPHA)))
    valid = np.zeros((24, 24), dtype=bool)
    valid[2:-2, 2:-2] = model.valid
    for kind, data in (("interaction_matrix", matrix), ("valid_sub_aps", np.hstack([valid] * 2))):
        record = {"format": 2, "kind": kind, "image_axes": "yx", "pyrtc_version": "2.1.0"}
        record |= {"wfs_type": "pywfs"} if kind == "valid_sub_aps" else {}
        name = {"interaction_matrix": "im", "valid_sub_aps": "valid"}[kind]
        np.savez(folder / f"{name}.npz", data=data, pyrtc_calibration=json.dumps(record))
    np.save(folder / "m2c.npy", basis.mode_to_actuator)
    np.save(folder / "xy.npy", instrument.analytic_mirror.positions_m)


def write_system(folder, _):
    """The system of the page, and a matrix of each pair by the model."""
    page = DOCS / "howto" / "systems.md"
    high, text = [text for text, _ in blocks_of(page, "toml")][:2]
    ground = high.replace('"high"', '"ground"').replace("pitch_m = 0.6", "pitch_m = 0.42")
    (folder / "ground.toml").write_text(ground.replace("12.5", "8.8"), encoding="utf-8")
    (folder / "high.toml").write_text(high, encoding="utf-8")
    (folder / "system.toml").write_text(text, encoding="utf-8")
    system = systems.load_system(folder / "system.toml")
    rng = np.random.default_rng(2)
    values = systems.moved(system, rng)
    matrices = []
    for pair in system.pairs:
        one = systems.matrix(system, pair, values)
        matrices.append(one + 0.005 * np.abs(one).max() * rng.normal(size=one.shape))
        sensor, mirror = system.names(pair)
        with h5py.File(folder / f"im_{sensor}_{mirror}.h5", "w") as file:
            file["interaction_matrix"] = matrices[-1]
    systems.recorded(folder / "all.h5", matrices, system)


def run_cacao(folder, reader):
    """A loop on streams, whose response is that of the ``conf`` folder; the page's two files."""
    write_sample(["cacao", str(folder / "there")])
    modes, pokes = (
        fits.getdata(folder / "there" / f"{name}.fits") for name in ("CMmodesDM", "zrespM-H")
    )
    response = pokes.reshape(len(pokes), -1).T / milk_loop.UNIT
    matrix = np.linalg.pinv(response @ modes.reshape(len(modes), -1).T)
    frames = response.reshape(*pokes.shape[1:], -1)
    turbulence_m = 1e-7 * np.arange(1, len(modes) + 1) ** -0.9
    plant, streams = folder / "plant.npz", folder / "streams"
    loop = {"response": frames, "modes": modes, "matrix": matrix, "sigma_m": turbulence_m}
    np.savez(plant, **loop, noise=4e-6, hz=200.0)
    streams.mkdir()
    live, bridge = (text for text, _ in blocks_of(DOCS / "tutorials" / "cacao.md", "toml"))
    (folder / "live.toml").write_text(live, encoding="utf-8")
    bridge = bridge.replace("tcp/127.0.0.1:7447", reader.night.zenoh)
    here = bridge.replace("[streams]", f'[streams]\ndirectory = "{streams}"')
    (folder / "cacao.toml").write_text(here, encoding="utf-8")
    loop = reader.night.start("loop", ["tests.system.milk_loop", str(streams), str(plant)])
    wait_for(lambda: "runs" in loop.log, 20.0, lambda: loop.log)


def run_an_rtc(folder, reader):
    """The example that the page names, a telescope for it, and its instrument file."""
    small = INSTRUMENT.read_text("utf-8").replace('name = "small"', 'name = "bench"')
    (folder / "bench.toml").write_text(small, encoding="utf-8")
    plant = str(write_plant(folder / "plant.npz"))
    words = ["examples.rtc_with_library", reader.night.zenoh, "bench", plant]
    reader.night.start("rtc", words)


PREPARED = {
    "tutorials/rtc": run_an_rtc,
    "tutorials/cacao": run_cacao,
    "fitting": write_bench_and_serve,
    "importing": write_imports,
    "pyrtc": write_pyrtc,
    "systems": write_system,
    "tracking": write_recording,
    "bundle": write_archive,
    "howto": write_bench,
}
"""What the reader of a page has before its first command."""

READ = sorted(
    page
    for page in PAGES
    if page.parent.name in {"start", "tutorials", "howto", "explanation"} or page.stem == "howto"
    if next(steps(page), None) is not None
)


@pytest.mark.parametrize("page", READ, ids=lambda page: page.stem)
def test_a_page_runs_and_prints_what_it_says(page, tmp_path, monkeypatch):
    folder = tmp_path / "desk"
    folder.mkdir()
    monkeypatch.chdir(folder)
    with a_night(tmp_path) as night:
        reader = Reader(folder, night)
        name = page.stem if page.parent.name != "tutorials" else f"tutorials/{page.stem}"
        PREPARED.get(name, lambda *_: None)(folder, reader)
        reader.read(page)
        for command in list(reader.beside):
            reader.end(command)


ALONE = {"fit", "reconstruct", "key"}
"""Commands that work on files, need nothing that runs, and take seconds."""

OPERATING = DOCS / "operate" / "operating.md"

ASKED = {"status", "reconstructors", "export", "audit", "dither", "stop", "resume"}
"""Commands to a running service that end at once and leave the night as it was."""


def desk_of(folder):
    """A folder with the files of the smallest bench and those of the checkout."""
    desk = folder / "desk"
    desk.mkdir()
    write_bench(desk, None)
    shutil.copytree(ROOT / "tests" / "data" / "tiny", desk / "tests" / "data" / "tiny")
    return desk


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
    [
        page
        for page in PAGES
        if page not in READ and any(words[0] in ALONE for words in typed(page))
    ],
    ids=lambda page: page.stem,
)
def test_what_works_on_files_works_as_it_is_written(page, tmp_path):
    desk = desk_of(tmp_path)
    for words in typed(page):
        if words[0] in ALONE and "flao-lbt" not in words:
            words = words[: words.index(">")] if ">" in words else words
            done = pyrcal(words, desk, tmp_path)
            assert done.returncode == 0, (words, done.stderr)


def asked_for_real(night, folder):
    """What docs/operate/operating.md types at a running service, in its order: each is answered."""
    done = []
    for words in typed(OPERATING):
        if words[0] in ASKED and not {"ID", "measurement", "recording", "rollback"} & set(words):
            answer = pyrcal(words, folder, folder, PYRCAL_URL=f"http://127.0.0.1:{night.port}")
            told = {0, 1} if words[0] == "status" else {0}  # 1: there is an alarm
            assert answer.returncode in told, (words, answer.stdout, answer.stderr)
            done.append(words[0])
    assert set(done) == ASKED


def test_what_operating_types_at_a_service_is_answered(tmp_path):
    """The service and the simulated RTC of the manual's bench; then its archive."""
    desk = desk_of(tmp_path)
    with a_night(tmp_path) as night:
        reader = Reader(desk, night)
        reader.start(["run", "--instrument", "bench.toml", "--mode", "propose"])
        reader.start(["sim", "--instrument", "bench.toml", "--seconds", "300"])
        known = wait_for(lambda: night.state["registration"], 60.0, lambda: night.state)
        assert max(known["sigma"].values()) < 0.2
        wait_for(lambda: night.ids("proposed"), 60.0, lambda: night.state)
        asked_for_real(night, tmp_path)
        reader.end("run")
        kept = [words for words in typed(OPERATING) if words[0] == "archive" and "aot" not in words]
        for words in kept:
            done = pyrcal(words, desk, desk / "data")
            assert done.returncode == 0, (words, done.stderr)
        assert [words[1] for words in kept] == ["list", "verify", "prune"]
