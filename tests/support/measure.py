"""What tests of several modules share of system.test_measure."""

from __future__ import annotations

import httpx

from tests.support.night import wait_for


def no_dither(night):
    night.post("/v1/dither", {"action": "stop"})
    wait_for(lambda: night.state["dither"] is None, what="no dither")


def measured(night, body, timeout_s=60.0):
    answer = night.client.post("/v1/measurements", json=body)
    assert answer.status_code == httpx.codes.ACCEPTED, answer.text
    path = f"/v1/measurements/{answer.json()['id']}"
    return wait_for(
        lambda: (lambda record: record if record["state"] != "running" else None)(
            night.client.get(path).json()
        ),
        timeout_s,
        "the end of the measurement",
    )
