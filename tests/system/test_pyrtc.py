"""pyRTC's loop on OOPAO's telescope is registered, and closes on our matrix as on OOPAO's own."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

from service.errors import PyrcalError
from service.files.bundle import Bundle, write_bundle
from tests.support.night import ROOT, a_night, wait_for

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


@pytest.fixture(scope="module")
def bench():
    from examples.pyrtc.bench import Bench

    bench = Bench()
    bench.begin(1)
    yield bench
    bench.close()


def runs_with(bench):
    loop, slopes = bench.loop, bench.slopes
    return [np.array(part) for part in (loop.g_cm, loop.effective_gains, slopes.ref_slopes)]


@pytest.mark.parametrize("ending", ["h5", "fits"])
def test_a_bundle_is_applied_between_two_frames_and_rolled_back_as_one_piece(
    bench, tmp_path, capsys, ending
):
    from examples.pyrtc.bridge import Bridge

    rng = np.random.default_rng(3)
    nominal = rng.normal(size=(20, bench.loop.signal_size)).astype(np.float32)
    bridge = Bridge(bench, "oopao", nominal)
    bridge.batch()
    before = runs_with(bench)
    arrays = {
        "reconstructor": rng.normal(size=(15, bench.loop.signal_size)).astype(np.float32),
        "gain_factor": rng.uniform(0.5, 1.0, size=15).astype(np.float32),
        "reference_slopes": rng.normal(size=bench.loop.signal_size).astype(np.float32),
        "mode_to_actuator": bench.modes,
    }
    facts = {"instrument": "oopao"}
    turned = Bundle(id="cm-2", arrays=arrays | {"mode_to_actuator": -bench.modes}, facts=facts)
    write_bundle(tmp_path / f"bundle.{ending}", turned)
    bridge.apply_files(tmp_path)
    bridge.batch()
    assert "found another basis" in capsys.readouterr().out
    assert all(map(np.array_equal, runs_with(bench), before))

    write_bundle(tmp_path / f"bundle.{ending}", Bundle(id="cm-2", arrays=arrays, facts=facts))
    bridge.apply_files(tmp_path)
    assert all(map(np.array_equal, runs_with(bench), before)), "not in the midst of a frame"
    header, _ = bridge.batch()
    g_cm, gains, reference = runs_with(bench)
    np.testing.assert_allclose(gains[:15], 0.5 * arrays["gain_factor"])
    np.testing.assert_allclose(g_cm[:15], gains[:15, None] * arrays["reconstructor"], rtol=1e-6)
    assert not np.array_equal(reference, before[2])
    assert (header.cm_id, bridge.take_swaps()) == ("cm-2", [("cm-2", header.seq0)])

    (tmp_path / "rollback").touch()
    bridge.apply_files(tmp_path)
    bridge.batch()
    assert all(map(np.array_equal, runs_with(bench), before))
    with pytest.raises(PyrcalError):
        bridge.apply(tmp_path / "rollback.taken")
