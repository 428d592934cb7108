"""A rehearsal: the service meets an RTC whose plant is a measured matrix, in axes of its own."""

import subprocess
import sys

import h5py
import pytest

from pyrcal.demo.truth import TruthFile
from service.instrument import load_instrument
from service.model.slopes import rtc_mask, to_rtc
from sim_rtc.assembly import build_telescope
from sim_rtc.options import parse_options
from tests.support.night import ALPHA, INSTRUMENT, N_START, N_TARGET, ROOT, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(240)]

MODEL_ERROR = 0.1
UNIT = 3e-7
"""Of the strokes, which nobody knows."""

SLOPES = """

[slopes]
order = "yx"
orientation = { swap_xy = false, flip_x = false, flip_y = true, sign = 1 }
"""


@pytest.fixture
def bench(tmp_path):
    """Return the instrument file of a matrix that the model explains to a tenth, and its file."""
    words = INSTRUMENT.read_text(encoding="utf-8")
    words = words.replace("pitch_m = 0.28", 'pitch_m = 0.28\nstroke = "unknown"')
    path = tmp_path / "bench.toml"
    path.write_text(words + SLOPES, encoding="utf-8")
    alpha = ",".join(map(str, ALPHA.values()))
    given = ["--alpha", alpha, "--imperfections", "ideal", "--model-error", str(MODEL_ERROR)]
    options = parse_options([*given, "--instrument", str(INSTRUMENT), "--seed", "5"])
    telescope = build_telescope(options, load_instrument(INSTRUMENT))
    about = load_instrument(path)
    mask = rtc_mask(telescope.plant.valid, about.slopes.assumed_orientation)
    matrix = to_rtc(telescope.optics.start().slopes_per_command, about.slopes, mask)
    with h5py.File(tmp_path / "matrix.h5", "w") as file:
        file["interaction_matrix"] = matrix * UNIT
    return path, tmp_path / "matrix.h5"


def test_the_service_is_rehearsed_on_a_measured_matrix(bench, tmp_path):
    """The RTC begins with the inverse of what was measured; the service's is as good."""
    instrument, matrix = bench
    live, path = tmp_path / "live.toml", tmp_path / "truth.jsonl"
    truth = TruthFile(path)
    plant = ["--plant", "measured", "--matrix", str(matrix), "--instrument", str(instrument)]
    command = [sys.executable, "-m", "sim_rtc", *plant, "--write-instrument", str(live)]
    subprocess.run(command, check=True, cwd=ROOT)
    assert load_instrument(live).mirror.stroke_known
    with a_night(tmp_path) as night:
        service = night.service(instrument=live)
        words = ["sim_rtc", "--connect", night.zenoh, *plant, "--seed", "3", "--mag", "6"]
        words += ["--n-controlled", str(N_START), "--leak", "0.99"]
        rtc = night.start("rtc", [*words, "--truth", str(path)])
        night.wait_for_rtc(rtc)
        own = wait_for(lambda: night.state["in_use"], what="the RTC's own matrix")
        night.wait_for_modes(N_TARGET)
        registration = wait_for(lambda: night.state["registration"], what="a registration")
        after = night.state["in_use"]
        wait_for(lambda: error_nm(truth, after, settling_s=4.0), 20.0, "wavefront errors")
        night.check_alarms()
        assert "Traceback" not in service.log + rtc.log
    found = registration["alpha"]
    for name, allowed in {
        "shift_x_subap": 0.03,
        "shift_y_subap": 0.03,
        "rotation_deg": 0.2,
    }.items():
        assert abs(found[name] - ALPHA[name]) < allowed, (name, found)
    assert error_nm(truth, after) < 1.1 * error_nm(truth, own)
    assert truth.last["shift_x_subap"] is None


def error_nm(truth, cm_id, settling_s=1.0):
    truth.read()
    return truth.wavefront_error_nm(cm_id, settling_s)
