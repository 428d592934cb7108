"""The REST application over real HTTP messages, with a hand-written service behind it."""

import hashlib
import io
import json
import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from prometheus_client.openmetrics.parser import (
    text_string_to_metric_families as openmetrics_families,
)
from prometheus_client.parser import text_string_to_metric_families

from service.archive.nights import Annotation
from service.errors import (
    ArchiveError,
    CommandError,
    LinkError,
    ModelError,
    StorageError,
    UnknownIdError,
)
from service.link.statistics import LinkStatistics
from service.model.misregistration import PARAMETERS
from service.records.alarms import ALARMS, Alarm, AlarmRecord, OperatorNote, Severity
from service.records.commands import (
    AbortAcquisition,
    AcknowledgeAlarm,
    Acquire,
    Approve,
    GainGroup,
    ModeGroup,
    MuteAlarm,
    Publish,
    Ramp,
    Refit,
    Reject,
    Rollback,
    SetLoop,
    SetMode,
    SetPointing,
    StartDither,
    StopDither,
    UnmuteAlarm,
)
from service.records.messages import as_message
from service.records.operations import (
    Acquisition,
    AcquisitionStage,
    CommandState,
    LoopCommand,
    MeasurementRecord,
    MeasureState,
)
from service.records.products import ModeSet
from service.records.registration import (
    ModeGain,
    PassiveBias,
    Source,
    SuspectedJump,
    Validity,
    ValidityState,
)
from service.records.state import Mode, TrackerState
from service.tracking.operations.running import ServiceState
from service.version import software_version
from service.web.views import to_json
from service.wire import DitherKind, Pattern, Pointing
from tests.support.api import (
    ALPHA,
    LINK,
    MATRIX,
    SECOND,
    SIGMA,
    STATE,
    VERDICT,
    assert_problem,
    body_of,
    entry,
)
from tests.support.states import changed

# --- reading


async def test_alpha_leaves_in_the_units_of_its_names(client):
    body = await body_of(client, "/v1/alpha")
    assert body["alpha"] == pytest.approx(
        {"shift_x_subap": 0.2, "shift_y_subap": -0.1, "rotation_deg": 0.3, "magnification": 1.005}
    )
    assert body["sigma"]["rotation_deg"] == pytest.approx(np.hypot(0.03, 0.005))
    assert body["tracking_sigma"]["rotation_deg"] == pytest.approx(0.03)
    assert body["sigma_limit"] is None
    assert body["floor"]["rotation_deg"] == pytest.approx(0.005)
    assert body["parameters"] == list(PARAMETERS)
    covariance = np.array(body["covariance"])
    assert covariance.shape == (4, 4)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), list(body["sigma"].values()))
    assert (body["age_s"], body["n_windows"], body["optical_gain"]) == (10.0, 4, 0.6)


async def test_the_age_is_judged_by_arrival(client, service):
    service.change(registration=replace(STATE.alpha.registration, arrived_ns_utc=98 * SECOND))
    assert (await body_of(client, "/v1/alpha"))["age_s"] == 2.0


async def test_before_the_first_window_alpha_is_a_problem_and_state_says_null(client, service):
    service.change(registration=None, accepted=0, refused=3)
    response = await client.get("/v1/alpha")
    assert_problem(response, 404, "no-estimate", "no estimate yet", "3 refused")
    assert (await body_of(client, "/v1/state"))["registration"] is None


async def test_state_shows_everything_at_one_glance(client):
    body = await body_of(client, "/v1/state")
    assert (body["system"], body["mode"], body["ready"]) == ("flao-lbt", "propose", True)
    assert body["uptime_s"] == 60.0
    assert body["registration"] == await body_of(client, "/v1/alpha")
    assert body["margin"]["worst_pole_radius"] == 0.8
    assert (body["rtc"]["frame_rate_hz"], body["rtc"]["magnitude"]) == (1000.0, None)
    assert body["dither"]["modes"] == [501, 450]
    assert body["dither_policy"]["phase"] == "sparse"
    assert body["dither_policy"]["plan"]["sigma"]["rotation_deg"] == pytest.approx(0.03)
    assert (body["dither_policy"]["mean_cost_m"], body["dither_policy"]["n_windows_learnt"]) == (
        3e-9,
        0,
    )
    assert body["vibrations_hz"] == [61.0]
    assert body["passive"]["sigma"]["rotation_deg"] == pytest.approx(0.3)
    assert body["passive"]["misfit"] is None
    assert body["alarms"][0]["name"] == "rtc.silent"
    assert (body["windows_accepted"], body["windows_refused"]) == (4, 1)
    assert body["link"]["frames_refused"] == {"basis": 8}


async def test_the_state_of_a_service_that_knows_nothing_is_readable(client, service):
    service.now = replace(service.now, tracker=TrackerState(system="bench"))
    body = await body_of(client, "/v1/state")
    assert body["rtc"] is body["margin"] is body["dither"] is body["passive"] is None
    assert body["passive_unavailable_reason"] == ""


async def test_the_state_says_why_ordinary_telemetry_says_nothing(client, service):
    silent = changed(
        STATE, passive_unavailable_reason="no passive estimate: the loop's delay is 1.5 frames"
    )
    service.now = replace(service.now, tracker=silent)
    assert (await body_of(client, "/v1/state"))[
        "passive_unavailable_reason"
    ] == silent.alpha.passive_unavailable_reason


def test_an_acquisition_is_shown_with_its_stage_and_what_it_found_in_degrees():
    under_way = Acquisition(stage=AcquisitionStage.CONFIRMING, text="looking", attempt=1)
    shown = to_json(replace(under_way, alpha=ALPHA))
    assert (shown["stage"], shown["under_way"], shown["n_attempts"]) == ("confirming", True, 1)
    assert shown["alpha"]["rotation_deg"] == pytest.approx(0.3)
    assert to_json(Acquisition())["alpha"] is None


@pytest.mark.parametrize(("image_sigma", "limited"), [(0.008, False), (0.0375, True)])
async def test_places_of_images_that_limit_sigma_are_named_with_the_command(
    client, service, image_sigma, limited
):
    places = np.array([image_sigma, image_sigma, 0.0, 0.0])
    known = replace(STATE.alpha.registration, image_floor=places)
    policy = replace(service.now.policy, image_sigma=places)
    state = changed(STATE, registration=known)
    service.now = replace(service.now, tracker=state, policy=policy)
    body = await body_of(client, "/v1/alpha")
    assert body["tracking_sigma"]["shift_x_subap"] == pytest.approx(SIGMA[0])
    assert body["sigma"]["shift_x_subap"] > image_sigma
    assert ("--light FRAME" in (body["sigma_limit"] or "")) is limited


async def test_a_reading_that_cannot_tell_has_no_sigma(client, service):
    lost = replace(STATE.alpha.passive, sigma=np.full(4, np.inf), text="it cannot tell")
    service.now = replace(service.now, tracker=changed(STATE, passive=lost))
    body = await body_of(client, "/v1/state")
    assert set(body["passive"]["sigma"].values()) == {None}


async def test_alpha_says_what_it_is_worth_and_since_when_it_was_not_dithered(client, service):
    registration = replace(
        STATE.alpha.registration,
        window_ns_utc=70 * SECOND,
        validity=ValidityState(level=Validity.AGEING, reason="σ grows", until_ns_utc=120 * SECOND),
        optical_gains=(ModeGain(mode=501, gain=0.6, sigma=0.01, scatter=0.03, t_ns_utc=1),),
        bias=PassiveBias(
            offset=np.array([0.05, 0.0, np.deg2rad(0.01), 0.0]),
            covariance=np.diag(SIGMA**2),
            shared=np.zeros((4, 4)),
            looked_ns_utc=1,
        ),
        pointing=Pointing(elevation_deg=61.0, azimuth_deg=120.0),
        restored_ns_utc=60 * SECOND,
        jumped_ns_utc=61 * SECOND,
    )
    service.change(registration=registration)
    body = await body_of(client, "/v1/alpha")
    assert (body["validity"], body["validity_reason"]) == ("ageing", "σ grows")
    assert body["valid_until_ns_utc"] == 120 * SECOND
    assert (body["age_s"], body["window_age_s"]) == (10.0, 30.0)
    assert body["restored_ns_utc"] == 60 * SECOND
    assert body["jumped_ns_utc"] == 61 * SECOND
    assert body["optical_gains"] == [
        {
            "mode": 501,
            "gain": 0.6,
            "gain_sigma": 0.01,
            "gain_scatter": 0.03,
            "t_ns_utc": 1,
            "t_utc": "1970-01-01T00:00:00.000000Z",
        }
    ]
    assert body["passive_bias"]["rotation_deg"] == pytest.approx(0.01)
    assert body["passive_bias_sigma"]["shift_x_subap"] == pytest.approx(SIGMA[0])
    assert body["pointing"] == {"elevation_deg": 61.0, "azimuth_deg": 120.0}


async def test_alpha_of_which_little_is_known_says_null(client):
    body = await body_of(client, "/v1/alpha")
    unknown = (
        "passive_bias",
        "passive_bias_sigma",
        "pointing",
        "restored_ns_utc",
        "jumped_ns_utc",
        "suspected",
    )
    assert all(body[name] is None for name in (*unknown, "window_age_s"))


async def test_a_suspected_jump_and_a_dither_that_is_due_are_seen(client, service):
    candidate = SuspectedJump(
        alpha=replace(ALPHA, shift_x_subap=0.5),
        covariance=np.diag(SIGMA**2),
        t_ns_utc=95 * SECOND,
        held_ns_utc=95 * SECOND,
    )
    service.change(
        registration=replace(STATE.alpha.registration, suspected_jump=candidate, doubt="a jump"),
        dither_due_since_ns_utc=95 * SECOND,
        dither_due_reason="a jump",
        outlying=3,
    )
    body = await body_of(client, "/v1/state")
    assert body["registration"]["suspected"]["shift_x_subap"] == 0.5
    assert (body["dither_due_since_ns_utc"], body["dither_due_reason"]) == (95 * SECOND, "a jump")
    assert body["windows_outlying"] == 3
    metrics = (await client.get("/metrics")).text
    assert 'pyrcal_alpha_validity{validity="fresh"} 1.0' in metrics
    assert 'pyrcal_windows_total{verdict="outlying"} 3.0' in metrics
    assert "pyrcal_dither_due 1.0" in metrics
    assert "pyrcal_dither_mean_meters 3e-09" in metrics
    assert 'pyrcal_dither_phase{phase="sparse"} 1.0' in metrics


async def test_history_is_the_newest_entries_oldest_first(client):
    body = await body_of(client, "/v1/alpha/history", limit=2)
    assert [e["t_ns_utc"] for e in body["entries"]] == [3 * SECOND, 4 * SECOND]
    assert body["entries"][0]["measured_sigma"]["rotation_deg"] == pytest.approx(0.06)
    assert body["entries"][0]["misfit"] == 1.2
    assert len((await body_of(client, "/v1/alpha/history"))["entries"]) == 5


async def test_the_last_goodness_of_fit_of_each_kind_is_measured(client, service):
    last = replace(entry(9), misfit=1.4, source=Source.RANDOM)
    seen = replace(STATE.alpha.passive, misfit=0.8)
    service.change(history=(*STATE.alpha.history, last, replace(last, misfit=1.3)), passive=seen)
    metrics = (await client.get("/metrics")).text
    found = {source: f'pyrcal_misfit_ratio{{source="{source}"}}' for source in Source}
    assert f"{found[Source.LOCK_IN]} 1.2" in metrics
    assert f"{found[Source.RANDOM]} 1.3" in metrics
    assert f"{found[Source.PASSIVE]} 0.8" in metrics


async def test_reconstructors_are_listed_with_the_one_in_use(client):
    body = await body_of(client, "/v1/reconstructors")
    assert body["in_use"] == "rtc-0"
    assert [r["id"] for r in body["reconstructors"]] == ["rtc-0", "cm-1"]
    assert body["reconstructors"][0]["alpha"] is None


async def test_one_reconstructor_is_shown_with_its_verdict(client):
    body = await body_of(client, "/v1/reconstructors/cm-1")
    assert (body["state"], body["parent"]) == ("proposed", "rtc-0")
    assert body["alpha"]["rotation_deg"] == pytest.approx(0.3)
    assert body["gate"]["accepted"] is True


async def test_an_unknown_reconstructor_is_a_problem(client):
    response = await client.get("/v1/reconstructors/cm-9")
    assert_problem(response, 404, "unknown-id", "cm-9")


async def test_events_are_the_log_and_the_alarms(client):
    body = await body_of(client, "/v1/events", limit=1)
    assert [e["text"] for e in body["log"]] == ["window 3"]
    assert body["log"][0]["level"] == "info"
    assert body["alarms"][0]["since_ns_utc"] == 70 * SECOND


async def test_numbers_that_are_not_finite_leave_as_null(client, service):
    verdict = replace(VERDICT, accepted=False, worst_pole_radius=float("inf"))
    registration = replace(STATE.alpha.registration, covariance=np.full((4, 4), np.nan))
    service.change(margin=verdict, registration=registration)
    text = (await client.get("/v1/state")).text
    body = json.loads(text, parse_constant=pytest.fail)
    assert body["margin"]["worst_pole_radius"] is None
    assert body["registration"]["covariance"][0][0] is None
    assert body["registration"]["sigma"]["shift_x_subap"] is None


# --- matrices


async def test_a_matrix_is_a_numpy_file_by_default(client):
    response = await client.get("/v1/reconstructors/cm-1/matrix")
    assert response.headers["content-type"] == "application/octet-stream"
    assert 'filename="cm-1.npy"' in response.headers["content-disposition"]
    found = np.load(io.BytesIO(response.content), allow_pickle=False)
    assert found.dtype == np.dtype("<f4")
    np.testing.assert_array_equal(found, MATRIX)


async def test_a_raw_matrix_has_its_shape_in_the_headers_and_the_records_checksum(client):
    response = await client.get("/v1/reconstructors/cm-1/matrix?format=raw")
    assert (response.headers["x-shape"], response.headers["x-dtype"]) == ("3,4", "<f4")
    np.testing.assert_array_equal(np.frombuffer(response.content, "<f4").reshape(3, 4), MATRIX)
    record = await body_of(client, "/v1/reconstructors/cm-1")
    assert hashlib.sha256(response.content).hexdigest() == record["sha256"]


async def test_a_matrix_is_read_outside_the_event_loop(client, service):
    await client.get("/v1/reconstructors/cm-1/matrix")
    assert service.thread not in {None, threading.get_ident()}


async def test_a_matrix_nobody_has_is_a_problem(client):
    response = await client.get("/v1/reconstructors/cm-9/matrix")
    assert_problem(response, 404, "unknown-id", "cm-9: no such matrix")


async def test_a_damaged_matrix_is_a_problem_that_says_so(client, service):
    service.refusal = ArchiveError("cm-1.h5: damaged")
    response = await client.get("/v1/reconstructors/cm-1/matrix")
    assert_problem(response, 500, "archive", "cm-1.h5: damaged")


# --- commands

BINARY = {"action": "start", "kind": "binary"}
SINE = {"pattern": "sine", "frequency_hz": [60.0]}
TWICE = [{"first": 0, "last": 2, "gain": 0.1}, {"first": 2, "last": 3, "gain": 0}]
UNSEEN = AcknowledgeAlarm(name="margin", by="Ada")


@pytest.mark.parametrize(
    ("method", "path", "body", "command"),
    [
        ("POST", "/v1/refit", None, Refit()),
        ("POST", "/v1/refit", {}, Refit()),
        ("POST", "/v1/refit", {"n_modes": 500}, Refit(n_modes=500)),
        ("POST", "/v1/dither", {"action": "stop"}, StopDither()),
        ("POST", "/v1/dither", {"action": "start"}, StartDither()),
        (
            "POST",
            "/v1/dither",
            {
                "action": "start",
                "modes": [501, 450],
                "amplitude_m": 5e-9,
                "frequency_hz": [210, 250.5],
                "duration_s": 60,
                "over_budget": True,
            },
            StartDither(
                modes=(501, 450),
                amplitude_m=5e-9,
                frequency_hz=(210.0, 250.5),
                duration_s=60.0,
                over_budget=True,
            ),
        ),
        ("POST", "/v1/reconstructors/cm-1/approve", None, Approve(id="cm-1")),
        ("POST", "/v1/reconstructors/cm-1/reject", None, Reject(id="cm-1")),
        (
            "POST",
            "/v1/reconstructors/cm-1/reject",
            {"reason": "no"},
            Reject(id="cm-1", reason="no"),
        ),
        ("POST", "/v1/reconstructors/cm-1/publish", {}, Publish(id="cm-1")),
        ("POST", "/v1/rollback", None, Rollback()),
        ("PUT", "/v1/mode", {"mode": "auto"}, SetMode(mode=Mode.AUTO)),
        ("POST", "/v1/acquisition", {"action": "start"}, Acquire()),
        ("POST", "/v1/acquisition", {"action": "abort"}, AbortAcquisition()),
        ("POST", "/v1/loop", {"loop": "open"}, SetLoop(loop="open")),
        ("POST", "/v1/loop", {"loop": "closed", "leak": 0.9}, SetLoop(loop="closed", leak=0.9)),
        ("POST", "/v1/loop", {"n_controlled": 300}, SetLoop(n_controlled=300)),
        ("POST", "/v1/loop", {"effective_gain": 0.3}, SetLoop(effective_gain=0.3)),
        (
            "POST",
            "/v1/loop",
            {"gains": [{"first": 0, "last": 1, "gain": 0.4}, {"first": 2, "last": 9, "gain": 0}]},
            SetLoop(
                gains=(GainGroup(first=0, last=1, gain=0.4), GainGroup(first=2, last=9, gain=0.0))
            ),
        ),
        ("POST", "/v1/loop/ramp", None, Ramp()),
        (
            "POST",
            "/v1/loop/ramp",
            {"groups": [{"first": 0, "last": 1}], "gains": [0.2, 0.5], "step_s": 0.5},
            Ramp(groups=(ModeGroup(first=0, last=1),), gains=(0.2, 0.5), step_s=0.5),
        ),
        (
            "POST",
            "/v1/dither",
            BINARY | {"modes": "all", "total_amplitude_m": 5e-9},
            StartDither(kind=DitherKind.BINARY, modes=ModeSet.ALL, total_amplitude_m=5e-9),
        ),
        (
            "POST",
            "/v1/dither",
            BINARY | {"modes": list(range(400))},
            StartDither(kind=DitherKind.BINARY, modes=tuple(range(400))),
        ),
        ("POST", "/v1/alarms/margin/acknowledge", {"by": "Ada"}, UNSEEN),
        (
            "POST",
            "/v1/alarms/margin/acknowledge",
            {"severity": "serious"},
            replace(UNSEEN, by="", severity=Severity.SERIOUS),
        ),
        ("POST", "/v1/alarms/margin/mute", {"for_s": 60.0}, MuteAlarm(name="margin", for_s=60.0)),
        ("POST", "/v1/alarms/margin/unmute", {}, UnmuteAlarm(name="margin")),
        (
            "PUT",
            "/v1/pointing",
            {"elevation_deg": 61.5, "azimuth_deg": -20.0},
            SetPointing(elevation_deg=61.5, azimuth_deg=-20.0),
        ),
    ],
)
async def test_a_command_is_handed_on_and_answered_202(
    client, service, method, path, body, command
):
    response = await client.request(method, path, json=body)
    assert response.status_code == 202, response.text
    assert service.commands == [command]
    answer = response.json()
    assert answer["text"].startswith(f"{type(command).__name__} is on its way")
    for link in answer["links"].values():
        assert (await client.get(link)).status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "body", "words"),
    [
        ("POST", "/v1/refit", {"n_mode": 5}, ["body.n_mode: unknown"]),
        (
            "PUT",
            "/v1/pointing",
            {"elevation_deg": 91.0, "azimuth_deg": 0.0},
            ["body.elevation_deg: found 91.0"],
        ),
        ("POST", "/v1/refit", {"n_modes": 0}, ["body.n_modes: found 0, expected greater than or"]),
        ("POST", "/v1/refit", {"n_modes": "5"}, ["body.n_modes: found '5', expected a valid int"]),
        ("POST", "/v1/refit", {"n_modes": 5.5}, ["body.n_modes: found 5.5"]),
        ("POST", "/v1/refit", [1], ["body: found [1]"]),
        ("POST", "/v1/dither", None, ["body: missing"]),
        ("POST", "/v1/dither", {}, ["body.action: missing"]),
        ("POST", "/v1/dither", {"action": "pause"}, ["'start', 'stop'"]),
        ("POST", "/v1/dither", {"action": "stop", "modes": [1]}, ["modes: unknown"]),
        ("POST", "/v1/dither", {"action": "start", "modes": [-1]}, ["modes.0: found -1"]),
        ("POST", "/v1/dither", {"action": "start", "modes": []}, ["modes: found []"]),
        ("POST", "/v1/dither", {"action": "start", "amplitude_m": 0}, ["amplitude_m: found 0"]),
        (
            "POST",
            "/v1/dither",
            {"action": "start", "modes": [1, 2], "frequency_hz": [200.0]},
            ["one frequency_hz for each of modes: 1 given for 2"],
        ),
        ("POST", "/v1/reconstructors/cm-1/approve", {"force": True}, ["body.force: unknown"]),
        ("POST", "/v1/reconstructors/cm-1/publish", {"force": True}, ["body.force: unknown"]),
        ("POST", "/v1/reconstructors/cm-1/reject", {"why": ""}, ["body.why: unknown"]),
        ("POST", "/v1/rollback", {"to": "cm-0"}, ["body.to: unknown"]),
        ("PUT", "/v1/mode", {"mode": "manual"}, ["'auto', 'propose' or 'hold'"]),
        ("POST", "/v1/acquisition", {}, ["body.action: missing"]),
        ("POST", "/v1/acquisition", {"action": "go"}, ["'start', 'abort'"]),
        ("POST", "/v1/acquisition", {"action": "start", "modes": [1]}, ["modes: unknown"]),
        ("POST", "/v1/loop", {}, ["at least one of loop, gains, leak, n_controlled"]),
        ("POST", "/v1/loop", {"loop": "partial"}, ["loop: found 'partial'"]),
        ("POST", "/v1/loop", {"leak": 1.5}, ["leak"]),
        ("POST", "/v1/loop", {"n_controlled": 0}, ["n_controlled"]),
        ("POST", "/v1/loop", {"gains": []}, ["gains"]),
        ("POST", "/v1/loop", {"gains": [{"first": 3, "last": 2, "gain": 0.1}]}, ["first <= last"]),
        ("POST", "/v1/loop", {"gains": [{"first": 0, "last": 2, "gain": -0.1}]}, ["gain"]),
        ("POST", "/v1/loop", {"gains": TWICE}, ["no mode in two groups: mode 2 is"]),
        ("POST", "/v1/loop", {"effective_gain": 0.3, "gains": TWICE[:1]}, ["not both"]),
        ("POST", "/v1/loop", {"speed": 3}, ["speed: unknown"]),
        ("POST", "/v1/loop/ramp", {"gains": [0.0]}, ["gains.0"]),
        (
            "POST",
            "/v1/loop/ramp",
            {"groups": [{"first": 0, "last": 1}] * 2},
            ["no mode in two groups"],
        ),
        ("POST", "/v1/loop/ramp", {"step_s": 61.0}, ["step_s"]),
        ("POST", "/v1/dither", {"action": "start", "kind": "noise"}, ["kind: found 'noise'"]),
        ("POST", "/v1/dither", BINARY | {"amplitude_m": 1e-9}, ["no amplitude_m and no frequ"]),
        ("POST", "/v1/dither", BINARY | {"frequency_hz": [250.0]}, ["no amplitude_m and no fre"]),
        ("POST", "/v1/dither", {"action": "start", "modes": "all"}, ["at most 64 modes with"]),
        ("POST", "/v1/dither", {"action": "start", "modes": list(range(65))}, ["at most 64"]),
        ("POST", "/v1/dither", {"action": "start", "modes": [3, 3]}, ["without any of them tw"]),
        (
            "POST",
            "/v1/dither",
            {"action": "start", "total_amplitude_m": 1e-9},
            ["no total_amplitude_m with sine"],
        ),
        ("POST", "/v1/alarms/margin/mute", {}, ["for_s"]),
        ("POST", "/v1/alarms/margin/mute", {"for_s": 0}, ["for_s"]),
        ("POST", "/v1/alarms/margin/mute", {"for_s": 43_201}, ["for_s"]),
        ("POST", "/v1/alarms/margin/mute", {"for_s": "an hour"}, ["for_s"]),
        ("POST", "/v1/measurements", {"pattern": "poke"}, ["pattern: found 'poke'"]),
        ("POST", "/v1/measurements", {"modes": []}, ["modes"]),
        ("POST", "/v1/measurements", {"modes": [-1]}, ["modes.0"]),
        ("POST", "/v1/measurements", {"modes": [1, 1]}, ["modes without any of them twice"]),
        ("POST", "/v1/measurements", {"amplitude_m": 0.0}, ["amplitude_m"]),
        ("POST", "/v1/measurements", {"n_average": 0}, ["n_average"]),
        ("POST", "/v1/measurements", SINE | {"n_average": 3}, ["no n_average with a sine"]),
        ("POST", "/v1/measurements", {"duration_s": 3.0}, ["no frequency_hz and no duration_s"]),
        ("POST", "/v1/measurements", SINE | {"modes": [1, 2]}, ["1 given for 2"]),
        ("POST", "/v1/measurements", SINE, ["1 given for 0"]),
        ("POST", "/v1/measurements", {"averages": 3}, ["averages: unknown"]),
        (
            "POST",
            "/v1/noisy-matrix",
            {"modes": "every"},
            ["modes: found 'every', expected a valid array or 'controlled' or 'all'"],
        ),
        ("POST", "/v1/noisy-matrix", {"modes": []}, ["modes: found []"]),
        ("POST", "/v1/noisy-matrix", {"modes": [1, 1]}, ["expected modes without any of them"]),
        ("POST", "/v1/noisy-matrix", {"modes": [-1]}, ["modes.0: found -1"]),
        ("POST", "/v1/noisy-matrix", {"total_amplitude_m": 0.0}, ["total_amplitude_m"]),
        ("POST", "/v1/noisy-matrix", {"duration_s": 4000.0}, ["duration_s"]),
        ("POST", "/v1/noisy-matrix", {"amplitude_m": 1e-9}, ["amplitude_m: unknown"]),
        ("PUT", "/v1/mode", {}, ["body.mode: missing"]),
    ],
)
async def test_a_body_that_cannot_be_used_is_refused(client, service, method, path, body, words):
    response = await client.request(method, path, json=body)
    assert_problem(response, 422, "invalid", *words)
    assert service.commands == []


@pytest.mark.parametrize("content", ["{", "NaN", '{"action": "start", "amplitude_m": NaN}'])
async def test_a_body_that_is_not_json_is_refused(client, service, content):
    response = await client.post(
        "/v1/dither", content=content, headers={"Content-Type": "application/json"}
    )
    assert_problem(response, 422, "invalid", "body")
    assert service.commands == []


async def test_json_that_is_not_declared_as_json_is_refused_with_what_to_do(client):
    response = await client.post(
        "/v1/refit",
        content='{"n_modes": 5}',
        headers={"Content-Type": "application/x-www-form-urlencoded"},
    )
    assert_problem(response, 422, "invalid", "expected JSON with Content-Type: application/json")


@pytest.mark.parametrize(
    "path",
    [
        "/v1/alpha/history?limit=0",
        "/v1/alpha/history?limit=many",
        "/v1/alpha/history?limt=3",
        "/v1/events?limit=-1",
        "/v1/reconstructors/cm-1/matrix?format=csv",
    ],
)
async def test_a_query_that_cannot_be_used_is_refused(client, path):
    assert_problem(await client.get(path), 422, "invalid", "query.")


@pytest.mark.parametrize(
    ("error", "status", "kind"),
    [
        (CommandError("no estimate yet: start a dither"), 409, "not-now"),
        (UnknownIdError("unknown reconstructor cm-1"), 404, "unknown-id"),
        (LinkError("the RTC did not answer within 1 s"), 504, "rtc-silent"),
        (ModelError("no such registration"), 500, "internal"),
        (StorageError("index.sqlite: cannot be used: disk is full"), 507, "archive-failed"),
    ],
)
async def test_a_refused_command_is_a_problem_in_the_services_own_words(
    client, service, error, status, kind
):
    service.refusal = error
    response = await client.post("/v1/reconstructors/cm-1/approve")
    assert_problem(response, status, kind, str(error))


async def test_a_fault_of_the_service_gives_nothing_away(client, service):
    service.refusal = ZeroDivisionError("secret")
    response = await client.post("/v1/rollback")
    assert_problem(response, 500, "internal", "fault of the service")
    assert "secret" not in response.text


# --- no such thing


async def test_an_unknown_path_is_a_problem(client):
    assert_problem(await client.get("/v2/state"), 404, "http", "nothing at /v2/state")


async def test_a_wrong_method_is_a_problem_that_says_what_is_allowed(client):
    response = await client.get("/v1/mode")
    assert_problem(response, 405, "http", "GET is not possible at /v1/mode")
    assert response.headers["allow"] == "PUT"


# --- health, metrics, description


async def test_healthz_answers_while_the_service_goes_on(client):
    assert await body_of(client, "/healthz") == {
        "status": "ok",
        "version": software_version(),
        "uptime_s": 60.0,
    }


async def test_healthz_of_a_service_that_stands_still_says_what_does(client, service):
    service.now = replace(service.now, stalled="the tick has stood still for 31 s")
    assert_problem(await client.get("/healthz"), 503, "stalled", "the tick has stood")


async def metrics_of(client):
    response = await client.get("/metrics")
    assert response.status_code == 200
    assert response.headers["content-type"].startswith("text/plain; version=")
    return {
        (sample.name.removeprefix("pyrcal_"), *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(response.text)
        for sample in family.samples
    }


async def test_metrics_count_everything_on_the_link(client):
    found = await metrics_of(client)
    for name in LinkStatistics.__slots__:
        value = getattr(LINK, name)
        if isinstance(value, dict):
            for key, count in value.items():
                assert found[f"{name}_total", key] == count
        elif isinstance(value, int):
            key = (name,) if name in {"rtc_alive", "frames_lost"} else (f"{name}_total",)
            assert found[key] == value
    assert found["frame_age_seconds",] == 0.01
    assert np.isnan(found["latency_p50_seconds",])


async def test_metrics_show_what_the_service_knows(client):
    found = await metrics_of(client)
    assert found["alpha_rotation_radians",] == pytest.approx(np.deg2rad(0.3))
    assert found["alpha_sigma_rotation_radians",] == pytest.approx(
        np.deg2rad(np.hypot(0.03, 0.005))
    )
    assert found["alpha_tracking_sigma_rotation_radians",] == pytest.approx(np.deg2rad(0.03))
    assert found["alpha_shift_x_subapertures",] == 0.2
    assert found["alpha_age_seconds",] == 10.0
    assert found["optical_gain_ratio",] == 0.6
    assert (found["windows_total", "accepted"], found["windows_total", "refused"]) == (4, 1)
    assert found["worst_pole_radius",] == 0.8
    assert found["stability_margin",] == pytest.approx(0.2)
    assert found["reconstructors", "proposed"] == 1
    assert found["reconstructors", "rejected"] == 0
    assert (found["alarms",], found["alarm", "rtc.silent"]) == (1, 1)
    assert (found["mode", "propose"], found["mode", "auto"]) == (1, 0)
    assert (found["ready", "worker"], found["uptime_seconds",]) == (1, 60.0)
    assert (found["archive_failures_total",], found["archive_waiting",]) == (3, 2)


async def test_metrics_show_the_optical_gain_of_each_dithered_mode(client, service):
    known = service.now.tracker.alpha.registration
    gain = ModeGain(mode=20, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=SECOND)
    service.change(registration=replace(known, optical_gains=(gain,)))
    found = await metrics_of(client)
    assert found["mode_optical_gain_ratio", "20"] == 0.5
    assert found["mode_optical_gain_sigma_ratio", "20"] == 0.01


MEASURING = MeasurementRecord(
    id="im-1",
    state=MeasureState.RUNNING,
    pattern=Pattern.HADAMARD,
    modes=(0, 1),
    amplitude_m=(2e-8, 2e-8),
    n_average=3,
    asked_ns_utc=70 * SECOND,
)


async def test_a_measurement_under_way_is_seen_in_the_state_and_the_metrics(client, service):
    assert (await body_of(client, "/v1/state"))["measuring"] is None
    found = await metrics_of(client)
    assert {found["measuring", pattern] for pattern in Pattern} == {0}
    service.change(measurements=(MEASURING,))
    assert (await body_of(client, "/v1/state"))["measuring"] == {
        "id": "im-1",
        "state": "running",
        "pattern": "hadamard",
        "modes": [0, 1],
        "asked_ns_utc": 70 * SECOND,
        "asked_utc": "1970-01-01T00:01:10.000000Z",
        "opens_loop": True,
    }
    found = await metrics_of(client)
    assert found["measuring", "hadamard"] == 1
    assert found["measuring", "sine"] == 0
    assert found["measuring_seconds",] == 30.0


async def test_the_loop_is_shown_by_groups_of_modes_with_what_was_last_asked_of_it(client, service):
    gains = (0.5, 0.5, 0.3, 0.0, 0.0)
    asked = LoopCommand(
        id="loop-1", text="open", state=CommandState.REFUSED, asked_ns_utc=7, reason="busy: im-1"
    )
    service.change(rtc=replace(STATE.loop.rtc, gains=gains), command=asked)
    body = await body_of(client, "/v1/state")
    assert body["rtc"]["gains"] == [
        {"first": 0, "last": 1, "gain": 0.5},
        {"first": 2, "last": 2, "gain": 0.3},
        {"first": 3, "last": 4, "gain": 0.0},
    ]
    assert (body["loop_command"]["state"], body["loop_command"]["reason"]) == (
        "refused",
        "busy: im-1",
    )


async def test_metrics_leave_as_openmetrics_for_those_who_ask(client):
    accept = {"Accept": "application/openmetrics-text; version=1.0.0"}
    response = await client.get("/metrics", headers=accept)
    assert response.headers["content-type"].startswith("application/openmetrics-text")
    families = {f.name: f for f in openmetrics_families(response.text)}
    assert families["pyrcal_frames_received"].samples[0].value == 3000


async def test_metrics_of_a_service_that_knows_nothing_are_readable(client, service):
    service.now = replace(
        service.now, tracker=TrackerState(system="bench"), link=replace(LINK, frame_age_s=None)
    )
    found = await metrics_of(client)
    assert ("alpha_rotation_radians",) not in found
    assert found["windows_total", "accepted"] == 0


async def test_openapi_describes_every_route_with_its_answers_and_errors(client):
    description = await body_of(client, "/openapi.json")
    operations = {
        f"{method.upper()} {path}": operation
        for path, methods in description["paths"].items()
        for method, operation in methods.items()
    }
    for name, operation in operations.items():
        assert operation["description"], name
        for status, answer in operation["responses"].items():
            expected = "application/problem+json" if status[0] in "45" else None
            assert answer["description"], name
            assert expected is None or list(answer["content"]) == [expected], (name, status)
        if not name.startswith("GET"):
            at_once = operation["tags"] == ["access"] or name in {
                "POST /v1/annotations",
                "DELETE /v1/fits/{id}",
            }
            assert at_once or "202" in operation["responses"], name
    assert "HTTPValidationError" not in description["components"]["schemas"]
    assert len({o["operationId"] for o in operations.values()}) == len(operations)


async def test_every_reference_in_openapi_has_a_target(client):
    text = (await client.get("/openapi.json")).text
    description = json.loads(text)

    def references(node):
        if isinstance(node, dict):
            yield from (v for k, v in node.items() if k == "$ref")
            node = list(node.values())
        if isinstance(node, list):
            for child in node:
                yield from references(child)

    found = set(references(description))
    assert found
    for reference in found:
        target = description
        for part in reference.removeprefix("#/").split("/"):
            target = target[part]


async def test_what_records_say_of_themselves_is_true_of_json(client):
    schemas = (await body_of(client, "/openapi.json"))["components"]["schemas"]
    assert "null" in schemas["AlphaView"]["properties"]["window_age_s"]["description"]
    for name, schema in schemas.items():
        texts = [schema, *schema.get("properties", {}).values()]
        for text in (text.get("description", "") for text in texts):
            assert not re.search(r"\bNone\b|NaN|numeric units|``\(4,\)``", text), (name, text)


UNITS = ("_s", "_m", "_hz", "_ns", "_ns_utc", "_deg", "_subap", "_frames", "_seq")
DIMENSIONLESS = {
    "bound",
    "condition_number",
    "difference",  # of two rows, over the size of one
    "effective_gain",
    "first",
    "flux",  # in whatever the RTC counts light in
    "gain",
    "gain_scatter",
    "gain_sigma",
    "held_sigma",  # of a ratio
    "id",
    "innovation",
    "last",
    "leak",
    "limit",
    "magnification",
    "magnitude",
    "margin",  # a pole radius over its bound
    "max_dither_modes",
    "misfit",
    "mode",
    "offset_rms",  # of slopes
    "optical_gain",
    "residual_fraction",  # RMS over RMS
    "residual_limit",  # of a ratio
    "seconds",  # is a unit
    "seed",
    "snr",
    "status",
    "value",  # of an operators' own rule, in whatever they tell it in
}
COUNTS = ("n_", "frames_", "windows_")


async def test_every_number_carries_its_unit_in_its_name(client):
    schemas = (await body_of(client, "/openapi.json"))["components"]["schemas"]

    def is_number(schema):
        types = {schema.get("type"), *(s.get("type") for s in schema.get("anyOf", ()))}
        return bool(types & {"number", "integer"})

    numbers = {
        name
        for schema in schemas.values()
        for name, field in schema.get("properties", {}).items()
        if is_number(field)
    }
    assert {"rotation_deg", "frame_rate_hz", "amplitude_m"} <= numbers
    for name in numbers - DIMENSIONLESS:
        assert name.endswith(("_radius", "_ratio", *UNITS)) or name.startswith(COUNTS), name


# --- alarms over REST: what is shown of them, and what operators do about them


ADA = OperatorNote(by="Ada", reason="known", t_ns_utc=80 * SECOND)


async def test_alarms_are_those_that_last_went_unseen_or_are_muted(client, service):
    service.change(
        active=(
            Alarm(name="loop-open", since_ns_utc=70 * SECOND, message=as_message("x", "open")),
        ),
        records=(
            AlarmRecord(name="loop-open", worst=Severity.WARNING, acknowledged=ADA),
            AlarmRecord(name="margin", worst=Severity.CRITICAL, text="bad", over_ns_utc=9 * SECOND),
            AlarmRecord(name="edge-slip", muted=replace(ADA, until_ns_utc=99 * SECOND)),
        ),
    )
    body = await body_of(client, "/v1/alarms")
    (lasting,), (stale,), (muted,) = (
        body[name] for name in ("alarms", "stale_alarms", "muted_alarms")
    )
    assert (lasting["name"], lasting["severity"]) == ("loop-open", "warning")
    assert lasting["alarm_state"] == "acknowledged"
    assert (lasting["acknowledged"]["by"], lasting["acknowledged"]["reason"]) == ("Ada", "known")
    assert lasting["acknowledged"]["t_utc"] == "1970-01-01T00:01:20.000000Z"
    assert (lasting["do"], lasting["text"]) == (ALARMS["loop-open"].do, "open")
    assert (stale["severity"], stale["worst_severity"]) == (None, "critical")
    assert (stale["alarm_state"], stale["text"]) == ("stale", "bad")
    assert stale["do"] == ALARMS["margin"].do
    assert (muted["name"], muted["muted"]["until_ns_utc"]) == ("edge-slip", 99 * SECOND)
    assert body["worst_severity"] == "critical"
    state = await body_of(client, "/v1/state")
    assert {name: state[name] for name in body} == body
    assert state["operating"]["service_state"] in set(ServiceState)
    found = await metrics_of(client)
    counted = ("alarms", "alarms_stale", "alarms_muted", "alarms_unacknowledged")
    assert [found[name,] for name in counted] == [1, 1, 1, 0]
    assert found["alarms_shown", "warning"] == 1
    assert found["service_state", state["operating"]["service_state"]] == 1


# --- notes of operators, and how two reconstructors are compared


NOTED = {"note": "dome closed, wind 18 m/s", "t_ns_utc": 50 * SECOND, "by": "Ada"}


async def test_a_note_is_kept_with_its_time_in_the_history_and_the_trail(client, service):
    response = await client.post("/v1/annotations", json=NOTED)
    assert response.status_code == 201, response.text
    where = response.headers["location"]
    (found,) = (await client.get(where)).json()["annotations"]
    assert (found["id"], found["t_ns_utc"], found["who"]) == (1, 50 * SECOND, "Ada")
    assert found["note"] == NOTED["note"]
    assert found["written_ns_utc"] > 50 * SECOND
    (mark,) = (await client.get("/v1/marks")).json()["marks"]
    assert (mark["kind"], mark["name"], mark["text"]) == ("note", "Ada", NOTED["note"])
    (entry,) = service.trail
    assert (entry.name, entry.who, entry.text) == ("annotation", "Ada", NOTED["note"])


async def test_a_note_without_a_time_is_of_now(client):
    await client.post("/v1/annotations", json={"note": "clouds"})
    (found,) = (await client.get("/v1/annotations")).json()["annotations"]
    assert found["t_ns_utc"] == found["written_ns_utc"]


async def test_notes_of_a_time_are_its_newest_oldest_first(client, service):
    for k in range(5):
        note = Annotation(t_ns_utc=k * SECOND, written_ns_utc=k, who="Ada", note=f"note {k}")
        service.archive.nights.add_note(note)
    asked = {"since_ns": SECOND, "until_ns": 4 * SECOND, "limit": 3}
    found = (await client.get("/v1/annotations", params=asked)).json()["annotations"]
    assert [one["note"] for one in found] == ["note 2", "note 3", "note 4"]


@pytest.mark.parametrize("body", [{}, {"note": ""}, {"note": "x" * 2001}, {"t_ns_utc": 5}])
async def test_a_note_that_says_nothing_is_refused(client, body):
    assert_problem(await client.post("/v1/annotations", json=body), 422, "invalid", "note")


async def test_a_note_the_disk_refuses_is_told(client, service, monkeypatch):
    def refuses(_):
        raise StorageError("disk full")

    monkeypatch.setattr(service.archive.nights, "add_note", refuses)
    refused = await client.post("/v1/annotations", json=NOTED)
    assert_problem(refused, 507, "archive-failed", "disk full")
    assert not service.trail


async def test_two_reconstructors_are_compared_mode_by_mode(client, service, monkeypatch):
    turned = -2.0 * MATRIX[:2]
    matrices = {"cm-1": MATRIX, "cm-2": turned, "cm-3": MATRIX[:, :2]}
    monkeypatch.setattr(service, "matrix", matrices.__getitem__)
    body = (await client.get("/v1/reconstructors/cm-1/compared-with/cm-2")).json()
    assert body["modes"] == [0, 1]
    assert body["gain"] == pytest.approx([0.5, 0.5])
    assert body["cosine"] == pytest.approx([-1.0, -1.0])
    assert body["difference"] == pytest.approx(1.5)
    same = (await client.get("/v1/reconstructors/cm-1/compared-with/candidate")).json()
    assert (same["other"], same["difference"]) == ("cm-1", 0.0)
    np.testing.assert_allclose(same["cosine"], 1.0, rtol=1e-3)
    other = await client.get("/v1/reconstructors/cm-1/compared-with/cm-3")
    assert_problem(other, 409, "not-now", "4 slopes in cm-1 and 2 in cm-3")
