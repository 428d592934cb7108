"""What watches the service from outside: metrics, rules and a dashboard, readiness, the log."""

import json
import re
from dataclasses import replace

import pytest
import structlog
import yaml
from prometheus_client.parser import text_string_to_metric_families

from service.cli.serve import log_to_the_terminal
from service.records.alarms import (
    ALARMS,
    ARCHIVE_FAILED,
    WORKER_BEHIND,
    Alarm,
    Prerequisite,
    Responsible,
)
from service.records.messages import as_message
from service.records.registration import Validity
from service.runtime.archiving import find_changed_ids, ids_of
from tests.support.api import LINK, SECOND, STATE, assert_problem
from tests.support.repository import ROOT
from tests.support.states import changed

SCRAPED = (ROOT / "deploy" / "prometheus.yml").read_text(encoding="utf-8")
RULES = yaml.safe_load((ROOT / "deploy" / "alerts.yml").read_text(encoding="utf-8"))
BOARD = json.loads((ROOT / "deploy" / "grafana.json").read_text(encoding="utf-8"))
EXPRESSIONS = {
    **{rule["alert"]: rule["expr"] for group in RULES["groups"] for rule in group["rules"]},
    **{
        f"{panel['title']}: {target['refId']}": target["expr"]
        for panel in BOARD["panels"]
        for target in panel["targets"]
    },
}
NOT_OURS = {"up"}
"""Prometheus makes it itself."""

NO_UNIT = {
    "alarm",
    "alarms",
    "alpha_validity",
    "archive_waiting",
    "build_info",
    "dither_due",
    "dither_phase",
    "frames_lost",
    "measuring",
    "alarms_muted",
    "alarms_shown",
    "alarms_stale",
    "alarms_unacknowledged",
    "mode",
    "current_operation",
    "service_state",
    "pole_radius_bound",
    "ready",
    "reconstructors",
    "references_in_use",
    "rtc_alive",
    "stability_margin",
    "waiting_for",
    "windows_late",
    "worst_pole_radius",
}
"""Counts, yes or no, and pure numbers."""

UNITS = ("_seconds", "_meters", "_bytes", "_ratio", "_radians", "_subapertures")


@pytest.fixture
async def families(client, service):
    """Every metric there is, of a service that knows everything."""
    service.change(
        active=tuple(
            Alarm(name=name, since_ns_utc=0, message=as_message("x", "")) for name in ALARMS
        )
    )
    text = (await client.get("/metrics")).text
    return {family.name: family for family in text_string_to_metric_families(text)}


def test_a_metric_is_in_a_base_unit(families):
    own = {n.removeprefix("pyrcal_"): f for n, f in families.items() if n.startswith("pyrcal_")}
    gauges = {name for name, family in own.items() if family.type == "gauge"}
    assert {name for name in gauges if not name.endswith(UNITS)} <= NO_UNIT
    for name, family in own.items():
        if family.type == "counter":  # the reader takes _total off
            assert all(sample.name.endswith("_total") for sample in family.samples), name


def test_no_label_holds_an_id(families, service):
    tracker = service.now.tracker
    ids = {
        tracker.matrices.in_use,
        tracker.loop.rtc.session,
        tracker.dithers.dither.id,
        tracker.system,
    }
    ids |= {record.id for record in tracker.matrices.reconstructors}
    labels = {v for f in families.values() for s in f.samples for v in s.labels.values()}
    assert not labels & ids
    assert len(labels) > 40


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_what_a_rule_or_a_panel_asks_for_is_measured(families, name):
    samples = {s.name: s for f in families.values() for s in f.samples}
    named = re.findall(r"(?<![\w$\"])([a-z]+_[a-z0-9_]+|up)\b(?:\{([^}]*)\})?", EXPRESSIONS[name])
    named = [(metric, said) for metric, said in named if metric not in {"label_values"}]
    assert named
    for metric, matchers in named:
        assert metric in NOT_OURS | samples.keys(), metric
        for label, value in re.findall(r'(\w+)=~?"([^"$]+)"', matchers):
            if metric in NOT_OURS:
                continue
            found = {s.labels.get(label) for f in families.values() for s in f.samples}
            assert set(value.split("|")) <= found, (metric, label)


def test_a_rule_says_what_is_the_matter_and_what_to_do():
    for group in RULES["groups"]:
        for rule in group["rules"]:
            assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
            assert rule["labels"]["severity"] in {"warning", "critical"}
            assert {"summary", "description"} == set(rule["annotations"])


# --- readiness


def alarm(name, text):
    return Alarm(name=name, since_ns_utc=70 * SECOND, message=as_message("x", text))


@pytest.mark.parametrize(
    ("changes", "part", "words"),
    [
        ({"link": replace(LINK, frame_age_s=12.0)}, "telemetry", "12 s ago"),
        ({"link": replace(LINK, frame_age_s=None)}, "telemetry", "no frame has come"),
        (
            {
                "waiting_for": (
                    Prerequisite(name="x", responsible=Responsible.RTC, text="odd", blocks=True),
                )
            },
            "telemetry",
            "odd",
        ),
        (
            {"tracker": changed(STATE, active=(alarm(ARCHIVE_FAILED, "disk full"),))},
            "archive",
            "disk full",
        ),
        (
            {"tracker": changed(STATE, active=(alarm(WORKER_BEHIND, "busy"),))},
            "worker",
            "busy",
        ),
        (
            {
                "waiting_for": (
                    Prerequisite(
                        name="w", responsible=Responsible.WORKER, text="died", blocks=True
                    ),
                )
            },
            "worker",
            "died",
        ),
    ],
)
async def test_readyz_names_the_part_that_does_not_do_its_work(
    client, service, changes, part, words
):
    assert (await client.get("/readyz")).status_code == 200
    service.now = replace(service.now, **changes)
    assert_problem(await client.get("/readyz"), 503, "not-ready", f"{part}: ", words)
    metrics = (await client.get("/metrics")).text
    for each in ("telemetry", "archive", "worker"):
        assert f'pyrcal_ready{{part="{each}"}} {float(each != part)}' in metrics


# --- the log


@pytest.fixture
def logged(capsys):
    """Return the lines that were written since it was asked last."""
    yield lambda: capsys.readouterr().err.splitlines()
    structlog.reset_defaults()


def test_a_log_that_nobody_looks_at_is_json(logged):
    log_to_the_terminal()
    structlog.get_logger().bind(system="flao").warning("rtc.odd", text="α is\x1b[1m odd", frame=7)
    (line,) = logged()
    told = json.loads(line)
    assert "α is" in line
    assert "\x1b" not in told["text"]
    assert (told["event"], told["level"], told["frame"]) == ("rtc.odd", "warning", 7)
    assert told["timestamp"].endswith("Z")


def test_a_traceback_is_one_line_of_json(logged):
    log_to_the_terminal("json")
    try:
        raise ValueError("broken")
    except ValueError:
        structlog.get_logger().exception("internal.error")
    (line,) = logged()
    assert "ValueError: broken" in json.loads(line)["exception"]


def test_text_can_be_asked_for(logged):
    log_to_the_terminal("text")
    structlog.get_logger().info("api.listening")
    assert "[info" in logged()[0]


async def test_a_request_is_found_in_the_log_by_the_id_of_its_answer(client, service, logged):
    log_to_the_terminal("json")
    service.snapshot = lambda: structlog.get_logger().info("seen") or service.now
    own = await client.get("/v1/state", headers={"X-Request-ID": "ticket-17"})
    other = await client.get("/v1/state", headers={"X-Request-ID": "a b\nc"})
    ids = [json.loads(line)["request_id"] for line in logged()]
    assert own.headers["x-request-id"] == ids[0] == "ticket-17"
    assert other.headers["x-request-id"] == ids[-1]
    assert re.fullmatch(r"[0-9a-f]{32}", ids[-1])
    structlog.get_logger().info("later")
    assert "request_id" not in logged()[-1]


def test_a_line_has_the_frame_and_the_matrices_it_is_about():
    state = changed(STATE, rtc=replace(STATE.loop.rtc, seq=81_234))
    assert ids_of(state, {"cm-1", "cm-9"}) == {
        "frame": 81_234,
        "in_use": "rtc-0",
        "matrices": ["cm-1"],
    }
    assert ids_of(STATE, ()) == {"in_use": "rtc-0"}
    proposed = replace(state.matrices.reconstructors[0])
    others = state.matrices.reconstructors[1:]
    after = changed(state, reconstructors=(proposed, *others))
    assert find_changed_ids(state, after) == {proposed.id}
    assert find_changed_ids(state, state) == set()


def test_what_alpha_is_worth_is_a_label_of_a_rule():
    (rule,) = [e for name, e in EXPRESSIONS.items() if name == "PyrcalRegistrationUnknown"]
    assert {Validity.STALE, Validity.PREDICTED, Validity.INVALID} == set(
        re.search(r'validity=~"([^"]+)"', rule)[1].split("|")
    )


def test_what_prometheus_is_told_has_its_key_in_two_lines_more():
    (plain,) = yaml.safe_load(SCRAPED)["scrape_configs"]
    assert "authorization" not in plain
    with_key = SCRAPED.replace("# authorization", "authorization").replace("#   cred", "  cred")
    (keyed,) = yaml.safe_load(with_key)["scrape_configs"]
    assert keyed == {**plain, "authorization": {"credentials_file": "pyrcal.key"}}
