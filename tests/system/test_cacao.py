"""A loop of cacao's, on streams alone, is registered through the bridge and takes up a matrix."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.files.bundle import read_bundle, write_bundle
from service.link.session import Endpoint, open_session, subscribe_frames
from service.wire import decode_frames
from tests.support import night as nights
from tests.support.cable import free_port
from tests.support.milk import Milk
from tests.support.night import ALPHA, N_START, N_TARGET, Process, a_night, wait_for
from tests.support.stranger import small_telescope
from tests.system.milk_loop import GAIN, HZ, MULT, UNIT, path_of

pytestmark = pytest.mark.system

SETTINGS = """
[wire]
connect = "{zenoh}"
system = "small"
basis_id = "kl-1"
config_id = "mask-1"
[streams]
directory = "{folder}"
dither = "dm01disp05"
[loop]
frame_rate_hz = {hz}
delay_frames = 2.0
n_slopes = {n_slopes}
n_modes = {n_modes}
metre_per_unit = {unit}
gain = {gain}
[calibration]
folder = "{folder}/matrices"
dm_modes = "{folder}/modes.npy"
interlock = "restart"
"""


@pytest.mark.long
@pytest.mark.timeout(120)
def test_the_loop_is_registered_and_takes_up_a_matrix_and_what_is_wrong_is_said(tmp_path):
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    n_slopes, n_modes = response.shape
    plant, folder = tmp_path / "plant.npz", tmp_path
    matrix = np.linalg.pinv(assumed[:, :N_START])
    modes = np.eye(n_modes)[:, None]  # a mirror whose actuators are its modes
    one = {"response": response[None], "sigma_m": np.sqrt(variance_m2), "modes": modes}
    np.savez(plant, **one, matrix=matrix, noise=2e-3, hz=HZ)
    np.save(folder / "modes.npy", modes[:, 0])
    with a_night(tmp_path) as night:
        same = nights.SETTINGS.replace(
            f"n_modes_target = {N_TARGET}", f"n_modes_target = {N_START}"
        )
        night.settings.write_text(same, encoding="utf-8")
        sizes = {"n_slopes": n_slopes, "n_modes": n_modes, "unit": UNIT, "hz": HZ, "gain": GAIN}
        config = folder / "cacao.toml"
        text = SETTINGS.format(zenoh=night.zenoh, folder=folder, **sizes)
        config.write_text(text.replace('interlock = "restart"', 'interlock = "operator"'))
        night.service("auto")
        loop = night.start("loop", ["tests.system.milk_loop", str(folder), str(plant)])
        wait_for(lambda: "runs" in loop.log, 20.0, lambda: loop.log)
        bridge = night.start("bridge", ["pyrcal", "cacao", "--config", str(config)])
        night.wait_for_rtc(bridge)
        known = wait_for(
            lambda: night.state["registration"], 30.0, lambda: (night.state, bridge.log)
        )
        for name, truth in ALPHA.items():
            assert abs(known["alpha"][name] - truth) < 4 * known["sigma"][name], (name, known)
        wait_for(lambda: "matrix.waits" in bridge.log, 40.0, lambda: (night.state, bridge.log))
        assert pyrcal("cacao", "--config", str(config), "--apply").startswith("cm-")
        night.wait_for_modes(N_START)
        in_use = night.state["in_use"]
        wait_for(lambda: night.rtc_says("cm_id") == in_use, 10.0, "its status names it")
        status = night.state["rtc"]
        assert status["leak"] == pytest.approx(MULT)
        first = {"first": 0, "last": N_START - 1, "gain": pytest.approx(GAIN)}
        assert status["gains"][0] == first
        assert not night.alarms.keys() & {"loop-law", "columns-misaligned", "response-mismatch"}

        goes_back_and_forth(night, config)

        Milk(path_of(folder, "aol1_imWFS2"), (7, 1))  # made anew by somebody, of another size
        told = f"aol1_imWFS2: found 7 values, expected {n_slopes}"
        said = lambda: [one["text"] for one in night.state["waiting_for"]]  # noqa: E731
        wait_for(lambda: told in said(), 10.0, lambda: (said(), bridge.log))


def goes_back_and_forth(night, config):
    """To the matrix before by one command, and by another to the bundle of the one in use."""
    night.client.put("/v1/mode", json={"mode": "hold"}).raise_for_status()
    in_use, folder = night.state["in_use"], night.directory
    bundle = folder / "tonight.fits"
    words = ["--data-dir", str(night.directory / "data"), "--instrument", str(nights.INSTRUMENT)]
    pyrcal("bundle", "write", "in-use", str(folder / "all.h5"), *words)
    whole = read_bundle(folder / "all.h5")
    arrays = {name: one for name, one in whole.arrays.items() if name != "mode_to_actuator"}
    write_bundle(bundle, replace(whole, arrays=arrays))  # this loop's mirror is its modes
    own = pyrcal("cacao", "--config", str(config), "--rollback").partition(":")[0]
    assert own.startswith("own-")
    wait_for(lambda: night.state["in_use"] == own, 10.0, lambda: night.state["in_use"])
    assert pyrcal("cacao", "--config", str(config), "--bundle", str(bundle)).startswith(in_use)
    wait_for(lambda: night.state["in_use"] == in_use, 10.0, lambda: night.state["in_use"])


def pyrcal(*words):
    done = subprocess.run(
        [sys.executable, "-m", "pyrcal", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("hz", "n_slopes", "most_of_a_core"), [(1000, 2048, 0.1), (2000, 15_000, None)]
)
def test_no_frame_is_lost_or_taken_for_another(tmp_path, hz, n_slopes, most_of_a_core):
    """Frames of 8 and of 60 KB; ``PYRCAL_CACAO_SECONDS`` of them, 60 unless told otherwise."""
    seconds, n_modes = float(os.environ.get("PYRCAL_CACAO_SECONDS", "60")), 500
    endpoint, folder, came = f"tcp/127.0.0.1:{free_port()}", tmp_path, {"n": 0, "next": 3, "bad": 0}
    np.save(folder / "modes.npy", np.ones((n_modes, 1)))

    def take(sample):
        batch = decode_frames(sample.payload.to_bytes(), sample.attachment.to_bytes())
        seq = batch.header.seq0 + np.arange(batch.header.n)
        whole = np.all(batch.slopes == seq[:, None]) and np.all(
            batch.commands_m == seq[:, None] - 2
        )
        came["bad"] += not whole or seq[0] != came["next"]
        came["n"], came["next"] = came["n"] + len(seq), int(seq[-1]) + 1

    sizes = {"n_slopes": n_slopes, "n_modes": n_modes, "unit": 1.0, "hz": float(hz), "gain": 0.0}
    config = folder / "cacao.toml"
    text = SETTINGS.format(zenoh=endpoint, folder=folder, **sizes).replace('"dm01disp05"', '""')
    text = text.replace("[streams]", '[streams]\ngains = ""\nfactors = ""')
    config.write_text(text)
    where = [str(folder), str(hz), str(n_slopes), str(n_modes), str(seconds)]
    with open_session(Endpoint(system="small", listen=(endpoint,))) as session:
        held = subscribe_frames(session, "ao/v1/small/tel/frames", take)
        writer = Process("writer", ["tests.system.milk_stream", *where], folder)
        wait_for(lambda: "runs" in writer.log, 20.0, lambda: writer.log)
        bridge = Process("bridge", ["pyrcal", "cacao", "--config", str(config)], folder)
        try:
            wait_for(lambda: came["n"], 20.0, lambda: bridge.log)
            begun, began_s = came["next"] - came["n"], time.monotonic()
            came["bad"] = 0
            spent_s = -processor_s(bridge.popen.pid)
            assert writer.ended(seconds + 60.0) == 0
            spent_s += processor_s(bridge.popen.pid)
            share = spent_s / (time.monotonic() - began_s)
            last = round(seconds * hz)
            wait_for(
                lambda: came["next"] == last + 1, 5.0, lambda: (came, bridge.log), every_s=0.05
            )
        finally:
            bridge.kill()
            writer.kill()
        del held
    sys.stdout.write(f"{came}, {share:.3f} of a core, {writer.log}")
    assert came["n"] == last + 1 - begun
    assert came["bad"] == 0
    assert most_of_a_core is None or share <= most_of_a_core


def processor_s(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
