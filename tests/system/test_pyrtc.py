"""pyRTC's loop on OOPAO's telescope is registered, and closes on our matrix as on OOPAO's own."""

import json
from importlib.util import find_spec

import pytest

from tests.system.night import ROOT, a_night, wait_for

MISSING = [name for name in ("pyrtc", "OOPAO") if find_spec(name) is None]
pytestmark = [
    pytest.mark.system,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(bool(MISSING), reason=f"{MISSING}: pip install pyrtcao oopao"),
]
TRUE = {"shift_x_subap": 0.3, "shift_y_subap": 0.0, "rotation_deg": 1.0}


def test_the_residual_is_that_of_oopaos_own_matrix_at_the_true_registration(tmp_path):
    with a_night(tmp_path) as night:
        words = ["examples.pyrtc", str(tmp_path), "--connect", night.zenoh, "--compare", "400"]
        loop = night.start("pyrtc", words)
        wait_for(lambda: "oopao.toml" in loop.log, 180.0, lambda: loop.log)
        night.settings = ROOT / "examples" / "pyrtc" / "settings.toml"
        night.service("auto", tmp_path / "oopao.toml")
        assert loop.ended(600.0) == 0, loop.log
        told = json.loads(loop.log.splitlines()[-1])
        for name, true in TRUE.items():
            assert abs(told["alpha"][name] - true) < 4 * told["sigma"][name], told
        (residual_nm,) = told["residual_nm"].values()
        assert residual_nm["pyrcal"] <= 1.02 * residual_nm["oopao"], told
