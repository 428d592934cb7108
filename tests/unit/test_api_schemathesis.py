"""What docs/openapi.json promises, asked of the real application by schemathesis, all its checks.

The service behind it is a real one with an archive, which an RTC has told its state once. That RTC
accepts whatever it is asked and there is no worker: what is ordered is decided as ever.
"""

import json
import re
from pathlib import Path

import pytest
import schemathesis
from schemathesis.config import SchemathesisConfig
from schemathesis.engine import from_schema
from schemathesis.engine.events import FatalError, NonFatalError, ScenarioFinished

from service.web.keys import KeyFile, KeyScope
from tests.support.api_schemathesis import application

OPENAPI = Path(__file__).parents[2] / "docs" / "openapi.json"

PHASES = ("examples", "coverage", "fuzzing", "stateful")

TOGETHER = {
    "POST /v1/dither": "no amplitude_m and no frequency_hz with binary|at most 64 modes with sine|"
    "no total_amplitude_m with sine|one frequency_hz for each|any of them twice",
    "POST /v1/measurements": "no n_average with a sine|no frequency_hz and no duration_s with|"
    "one frequency_hz for each|any of them twice",
    "POST /v1/noisy-matrix": "any of them twice",
    "POST /v1/references": "frame (mirror|instrument) with|no unit with slopes|a unit: m, um or nm|"
    "a square map|a shape of|slopes that are not all 0",
    "POST /v1/loop": "at least one of loop|gains or effective_gain|no mode in two groups|first <=",
    "POST /v1/loop/ramp": "no mode in two groups|first <=",
    "POST /v1/fits": r"query\.(modes|start|instrument): found|unusable-matrix ",
}
"""Of each operation, rules that JSON Schema cannot say: what is refused by one of them is meant."""

ANYWHERE = (
    r"expected printable characters|found [-\d.e+]+, expected a valid integer|"
    "a time in nanoseconds or as RFC 3339|expected a time from 1970-|since <= until"
)
"""Names and reasons that act on a terminal; a whole number that is written as 36.0; times."""


@pytest.fixture
def app(tmp_path):
    with application(tmp_path, KeyFile(tmp_path)) as made:
        yield made


def found_by_asking(app, key, phases, n_examples):
    """Return every failure that schemathesis finds, and how many requests it has sent."""
    config = SchemathesisConfig.from_dict(
        {
            "headers": {"Authorization": f"Bearer {key}"},
            "continue-on-failure": True,
            "generation": {
                "max-examples": n_examples,
                "deterministic": True,
                "no-shrink": True,
                "database": "none",
            },
            "phases": {name: {"enabled": name in phases} for name in PHASES},
        }
    )
    described = json.loads(OPENAPI.read_text(encoding="utf-8"))
    del described["paths"]["/v1/keys/{name}"]  # it would revoke its own
    del described["paths"]["/v1/stream"]  # which never ends
    schema = schemathesis.openapi.from_dict(described, config=config)
    schema.app = app
    found, n_requests = [], 0
    for event in from_schema(schema).execute():
        if isinstance(event, FatalError):
            raise event.exception
        if isinstance(event, NonFatalError):
            found.append(f"{event.label}: {event.value!r}")
        if isinstance(event, ScenarioFinished):
            n_requests += len(event.recorder.interactions)
            found += failures_of(event.recorder)
    return found, n_requests


def failures_of(recorder):
    for case, checks in recorder.checks.items():
        asked = recorder.interactions[case]
        label = recorder.cases[case].value.operation.label
        answer = asked.response
        for check in checks:
            if check.failure_info is None or is_meant(check.name, label, answer):
                continue
            told = None if answer is None else (answer.status_code, answer.content[:600])
            asked_for = (asked.request.uri[:300], asked.request.body)
            yield f"{check.name} {label}: {check.failure_info.failure}: {asked_for} -> {told}"


def is_meant(check, label, answer):
    try:
        problem = json.loads(answer.content)
        told = f"{problem['type'].removeprefix('urn:pyrcal:problem:')} {problem['detail']}"
    except (ValueError, KeyError, TypeError, AttributeError):
        return False
    if check == "not_a_server_error":
        return label == "GET /readyz" and told.startswith("not-ready ")
    together = TOGETHER.get(label, "(?!)")
    return check == "positive_data_acceptance" and bool(re.search(f"{ANYWHERE}|{together}", told))


@pytest.fixture
def key(tmp_path):
    return KeyFile(tmp_path).add("schemathesis", KeyScope.ADMIN)


def test_every_answer_is_as_the_openapi_says(app, key):
    """Also where what one answers goes into the next: ids, and what an order has changed."""
    found, n_requests = found_by_asking(app, key, ("fuzzing", "stateful"), 1)
    assert n_requests > 100
    assert not found, "\n".join(found)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_thousands_of_answers_are_as_the_openapi_says(app, key):
    found, n_requests = found_by_asking(app, key, PHASES, 30)
    assert n_requests > 3000
    assert not found, "\n".join(found)
