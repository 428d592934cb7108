"""A commissioning as docs/operate/commissioning.md has it, on a short simulated night."""

import json
import time
from functools import partial

import httpx
import pytest

from tests.support.fitting import pyrcal
from tests.support.measure import measured, no_dither
from tests.support.night import INSTRUMENT, a_night, wait_for

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(400)]

SAMPLED_S = 33.0
"""Two trend samples of 15 s each."""


def test_a_simulated_night_is_commissioned_and_accepted(tmp_path):
    with a_night(tmp_path) as night:
        rtc = night.rtc()
        words = ["check-rtc", "--instrument", INSTRUMENT, "--listen", night.zenoh]
        checked = pyrcal(*words, "--yes", "--open-loop", "--json", folder=tmp_path)
        assert checked.returncode == 0, (checked.stdout, checked.stderr, rtc.log)
        (tmp_path / "check.json").write_text(checked.stdout, encoding="utf-8")

        night.service("propose")
        wait_for(lambda: night.ids("proposed"), 60.0, lambda: night.state)
        time.sleep(SAMPLED_S)
        theirs = night.state["in_use"]
        # Refused for seconds while ordinary telemetry puts α in question: an operator asks again.
        approve = partial(night.client.post, "/v1/reconstructors/candidate/approve")
        wait_for(lambda: approve().status_code == httpx.codes.ACCEPTED, 40.0, lambda: night.alarms)
        wait_for(lambda: night.state["in_use"] != theirs, 40.0, lambda: night.alarms)
        time.sleep(SAMPLED_S)

        # the commissioning of the night ends here; the measurement opens the loop
        until = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        no_dither(night)
        record = measured(night, {"pattern": "push-pull-modal", "n_average": 60})
        assert record["state"] == "stored", record
        product = night.client.get(
            f"/v1/measurements/{record['id']}/matrix", params={"format": "hdf5"}
        )
        (tmp_path / "im.h5").write_bytes(product.content)

    fitted = pyrcal("fit", INSTRUMENT, "im.h5", "--gain", "0.4", "--json", folder=tmp_path)
    assert fitted.returncode == 0, fitted.stderr
    (tmp_path / "fit.json").write_text(fitted.stdout, encoding="utf-8")
    given = ["--config", "settings.toml", "--data-dir", "data", "--instrument", INSTRUMENT]
    given += ["--check-rtc", "check.json", "--fit", "fit.json", "--until", until, "--json"]
    done = pyrcal("commission", *given, folder=tmp_path)
    criteria = json.loads(done.stdout)
    assert [one for one in criteria if one["outcome"] != "pass"] == []
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "commissioning.html").read_text(encoding="utf-8")
    assert page.count("<svg") >= 3
    assert "ACCEPTED: 16 of 16" in page
