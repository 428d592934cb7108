"""The command line over REST, beside the service's own application on a real socket."""

import asyncio
import contextlib
import csv
import itertools
import json
import socket
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pyrcal.__main__ import main
from pyrcal.client import orders
from pyrcal.client.reading import SCREENS
from pyrcal.client.remote import REQUESTS
from service.api import create_app
from service.archive import AuditEntry, Channel
from service.archive.products import RecordingRecord
from service.control.gains import gain_table
from service.errors import CommandError
from service.records.events import MatrixMade
from service.records.operations import AcquisitionStage
from service.records.products import (
    Frame,
    MatrixState,
    ReconstructorRecord,
    ReferencesRecord,
    Shape,
    ShapeKind,
)
from service.records.registration import MeasuredGains, ModeGain
from service.records.state import Mode, ReferenceStates
from service.tracker import step
from service.web.connections import Server
from tests.support.api import MATRIX, SECOND, STATE, FakeService, a_snapshot
from tests.support.situations import ALL_SHOWN, POLICY, rtc
from tests.support.states import changed

BEFORE = ReconstructorRecord(
    id="cm-0", state=MatrixState.SUPERSEDED, n_modes=300, created_ns_utc=SECOND
)
NCPA = str(Path(__file__).parents[2] / "data" / "ncpa.json")
SHAPE = Shape(
    id="shape-1",
    kind=ShapeKind.ZERNIKE,
    frame=Frame.INSTRUMENT,
    values=(0.0, 3e-9, 6e-8),
    source="ncpa.json",
    by="Ada",
    loaded_ns_utc=SECOND,
)
TRAIL = tuple(
    AuditEntry(t_ns_utc=k * SECOND, who="Ada", name="Stop", text="a\x1b[2Jb", why="clouds", id=k)
    for k in (1, 2)
)


class Listening(FakeService):
    """Checks, as the service does, whether what was decided on is still so."""

    async def submit(self, command, caller, order_id=""):
        caller.check()
        return await super().submit(command, caller, order_id)


@contextlib.contextmanager
def serving(app):
    """Serve in a thread; yield the address."""
    listener = socket.create_server(("127.0.0.1", 0))
    server = Server(app, asyncio.Event(), within_s=1)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


def clock():
    """A second passes at each look."""
    seconds = itertools.count()
    return SimpleNamespace(sleep=lambda _: None, monotonic=lambda: next(seconds))


@pytest.fixture(scope="module")
def served():
    service = Listening(None)
    trail = lambda part: [e for e in TRAIL if e.id > (part.after or 0)]  # noqa: E731
    nights = SimpleNamespace(n_estimates=lambda *_: 0)
    service.archive = SimpleNamespace(audit_trail=trail, nights=nights)
    with serving(create_app(service)) as url:
        yield service, url


@pytest.fixture
def service(served, monkeypatch):
    service, url = served
    monkeypatch.setenv("PYRCAL_URL", url)
    monkeypatch.setattr(orders, "time", clock())
    tracker = changed(
        STATE,
        reconstructors=(BEFORE, *STATE.matrices.reconstructors),
        verified_ids=frozenset({STATE.loop.rtc.cm_id}),
        mode_proof=ALL_SHOWN,
    )
    offered = ReferenceStates(
        shape=SHAPE,
        used_id="ref-1",
        records=(
            ReferencesRecord(id="ref-1", state=MatrixState.APPLIED, created_ns_utc=SECOND),
            ReferencesRecord(
                id="ref-2",
                state=MatrixState.PROPOSED,
                created_ns_utc=SECOND,
                shape=SHAPE.id,
                coefficients_m=(0.0, 6e-8),
                gain=0.6,
                unexplained_ratio=0.08,
                reason="waits",
            ),
        ),
    )
    service.now = a_snapshot(replace(tracker, references=offered))
    service.commands, service.callers, service.refusal = [], [], None
    return service


def at_the_next_look(monkeypatch, happens):
    monkeypatch.setattr(orders.time, "sleep", lambda _: happens())


def becomes(service, name, state):
    """What an order would lead to: a reconstructor is in another state."""
    known = (
        replace(one, state=state) if one.id == name else one
        for one in service.now.tracker.matrices.reconstructors
    )
    service.change(reconstructors=tuple(known))


ORDERS = [
    (["mode", "hold"], "SetMode", {"mode": Mode.HOLD}),
    (["mode", "auto"], "SetMode", {"mode": Mode.AUTO}),
    (["stop"], "StopEverything", {}),
    (["resume"], "Resume", {}),
    (["dither", "stop"], "StopDither", {}),
    (["loop", "open", "--yes"], "SetLoop", {"loop": "open"}),
    (["loop", "close", "--yes"], "SetLoop", {"loop": "closed"}),
    (["dither", "start", "--modes", "3,5", "--frequency-hz", "90,110"], "StartDither",
     {"modes": (3, 5), "frequency_hz": (90.0, 110.0), "over_budget": False}),
    (["dither", "start", "--kind", "binary", "--modes", "all", "--over-budget"], "StartDither",
     {"modes": "all", "over_budget": True}),
    (["reconstructors", "compute", "--n-modes", "300", "--no-wait"], "Refit", {"n_modes": 300}),
    (["loop", "abort"], "AbortAcquisition", {}),
    (["loop", "acquire", "--yes", "--no-wait"], "Acquire", {}),
    (["reconstructors", "approve", "--yes", "--no-wait"], "Approve", {"id": "cm-1"}),
    (["reconstructors", "reject"], "Reject", {"id": "cm-1"}),
    (["reconstructors", "publish", "previous", "--yes", "--no-wait"], "Publish", {"id": "cm-0"}),
    (["reconstructors", "rollback", "--yes", "--no-wait"], "Rollback", {}),
    (["measure", "matrix", "--yes", "--no-wait", "--n-average", "3"], "Measure", {"n_average": 3}),
    (["measure", "noisy", "--no-wait", "--duration-s", "9"], "MeasureNoisy", {"duration_s": 9.0}),
    (["alarms", "ack", "margin"], "AcknowledgeAlarm", {"name": "margin", "severity": None}),
    (["alarms", "mute", "margin", "600"], "MuteAlarm", {"name": "margin", "for_s": 600.0}),
    (["alarms", "unmute", "margin"], "UnmuteAlarm", {"name": "margin"}),
    (["measure", "cancel", "im-1"], "GiveUp", {"id": "im-1"}),
    (["references", "load", NCPA, "--unit", "nm"], "LoadShape",
     {"kind": "zernike", "frame": "instrument", "values": (0.0, 3.0, 60.0), "unit": "nm"}),
    (["references", "approve", "--yes", "--no-wait"], "ApproveReferences", {"id": "ref-2"}),
    (["references", "reject"], "RejectReferences", {"id": "ref-2"}),
    (["references", "rollback", "--yes"], "RollBackReferences", {}),
    (["references", "clear", "--yes"], "ClearShape", {}),
]  # fmt: skip


def test_every_order_of_the_table_is_tried_below():
    tried = {
        " ".join(words[: 1 if words[0] in {"mode", "stop", "resume"} else 2])
        for words, _, _ in ORDERS
    }
    tried |= {"recordings start", "recordings end", "recordings remove"}
    assert tried == {one.name for one in REQUESTS if one.module == "orders"}


@pytest.mark.parametrize(("words", "kind", "fields"), ORDERS)
def test_an_order_reaches_the_service_with_who_and_why(capsys, service, words, kind, fields):
    assert main([*words, "--why", "clouds, still", "--who", "Ada"]) == 0
    (command,) = service.commands
    assert type(command).__name__ == kind
    assert (command.reason, command.by) == ("clouds, still", "Ada")
    assert {name: getattr(command, name) for name in fields} == fields
    assert [caller.channel for caller in service.callers] == [Channel.CLI]
    assert f"{kind} is on its way" in capsys.readouterr().out


def test_without_a_name_it_is_the_login_name(service, monkeypatch):
    monkeypatch.setattr("getpass.getuser", lambda: "grace")
    assert main(["mode", "hold"]) == 0
    assert service.commands[0].by == "grace"


def test_a_refusal_is_said_in_full_and_is_no_success(capsys, service):
    service.refusal = CommandError("not now: the \x1b[2J moon")
    assert main(["stop"]) == 1
    assert capsys.readouterr().err == "pyrcal stop: not now: the \\x1b[2J moon\n"


def test_all_that_rest_finds_wrong_is_said(capsys, service):
    assert main(["dither", "start", "--modes", "3,3", "--amplitude-m", "-1"]) == 1
    assert "amplitude_m: found -1" in capsys.readouterr().err
    assert service.commands == []


def test_what_is_decided_on_is_shown_and_the_service_told_which_it_was(capsys, service):
    assert main(["reconstructors", "approve", "--yes", "--no-wait"]) == 0
    told = capsys.readouterr().err
    assert "cm-1: proposed, 400 modes" in told
    assert "worst pole radius 0.800, limit 0.95: accepted" in told
    assert "rotation      +0.3000 ± 0.0300 deg" in told


def test_what_changes_while_somebody_decides_is_not_decided(capsys, service, monkeypatch):
    monkeypatch.setattr(
        orders, "_prompt_user", lambda *_: becomes(service, "cm-1", "failed") or "yes"
    )
    assert main(["reconstructors", "approve", "--no-wait"]) == 1
    assert "read it again" in capsys.readouterr().err
    assert service.commands == []


@pytest.mark.parametrize(
    "words",
    [
        ["reconstructors", "approve"],
        ["reconstructors", "reject"],
        ["reconstructors", "rollback", "--why", "so"],
    ],
)
def test_where_nobody_can_be_asked_nothing_is_ordered(capsys, service, words):
    assert main(words) == 2
    assert "expected --" in capsys.readouterr().err
    assert service.commands == []


@pytest.mark.parametrize(("said", "status"), [("", 1), ("n", 1), ("yes", 0)])
def test_only_a_yes_is_one(service, monkeypatch, said, status):
    monkeypatch.setattr(orders, "_prompt_user", lambda *_: said)
    assert main(["reconstructors", "publish", "cm-0", "--no-wait"]) == status
    assert len(service.commands) == (status == 0)


@pytest.mark.parametrize(("end", "status"), [(MatrixState.APPLIED, 0), (MatrixState.REJECTED, 1)])
def test_an_approval_is_done_when_the_rtc_has_applied_it(capsys, service, monkeypatch, end, status):
    becomes(service, "cm-1", MatrixState.PUBLISHED)
    at_the_next_look(monkeypatch, lambda: becomes(service, "cm-1", end))
    assert main(["reconstructors", "approve", "cm-1", "--yes"]) == status
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"cm-1 is {end}")


class Keeping:
    """Keeps telemetry as long as it is looked at twice."""

    def __init__(self):
        self.told, self.looks = [], 0

    async def begin(self, *said):
        self.told.append(said)
        return self.all()[0]

    async def end(self, *said):
        self.told.append(said)
        return self.all()[0]

    async def remove(self, *said):
        self.told.append(said)

    def all(self):
        self.looks += 1
        state = "running" if self.looks < 3 else "stored"
        record = RecordingRecord(
            id="tm-1", state=state, created_ns_utc=1, duration_s=5, who="", why=""
        )
        return (record,)


def test_telemetry_is_kept_and_followed_ended_and_removed(capsys, service):
    kept = service.recordings = Keeping()
    who = ["--why", "odd edge", "--who", "Ada"]
    assert main(["recordings", "start", "--duration-s", "5", *who]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "tm-1 keeps telemetry for 5 s",
        "tm-1 is stored",
    ]
    assert main(["recordings", "list"]) == 0
    assert "tm-1  stored" in capsys.readouterr().out
    assert main(["recordings", "end", "tm-1", *who]) == 0
    assert main(["recordings", "remove", "tm-1", "--yes", *who]) == 0
    begun = (5.0, "Ada", "odd edge", 0.0)  # nothing of before
    assert kept.told == [begun, ("Ada has ended it", "tm-1"), ("tm-1",)]
    assert capsys.readouterr().out.splitlines() == ["tm-1 has ended: 0 MB", "tm-1 is removed"]


@pytest.mark.parametrize(
    "words", [["reconstructors", "rollback", "--why", "so"], ["reconstructors", "publish", "cm-0"]]
)
def test_what_goes_out_again_is_followed_until_the_rtc_has_applied_it(
    capsys, service, monkeypatch, words
):
    copy = replace(BEFORE, id="cm-2", parent="cm-0", state=MatrixState.STAGED)
    known = service.now.tracker.matrices.reconstructors
    coming = iter((known, (*known, copy), (*known, replace(copy, state=MatrixState.APPLIED))))
    at_the_next_look(monkeypatch, lambda: service.change(reconstructors=next(coming)))
    assert main([*words, "--yes"]) == 0
    told = capsys.readouterr()
    assert "cm-0 is proposed: judged again before it is sent" in told.err
    assert told.out.splitlines()[-1] == "cm-2 is applied"


def test_an_rtc_that_never_applies_it_is_not_waited_for_for_ever(capsys, service):
    becomes(service, "cm-1", MatrixState.STAGED)
    assert main(["reconstructors", "approve", "cm-1", "--yes"]) == 1
    assert "cm-1 is staged: waits, still" in capsys.readouterr().out


def at(service, stage):
    service.change(acquisition=replace(STATE.operations.acquisition, stage=stage, text="so far"))


@pytest.mark.parametrize(
    ("end", "status"), [(AcquisitionStage.TRACKING, 0), (AcquisitionStage.FAILED, 1)]
)
def test_an_acquisition_is_followed_to_its_end(capsys, service, monkeypatch, end, status):
    at(service, AcquisitionStage.COARSE)
    at_the_next_look(monkeypatch, lambda: at(service, end))
    assert main(["loop", "acquire", "--yes", "--why", "first light"]) == status
    told = capsys.readouterr()
    assert "acquisition, coarse: so far" in told.err
    assert told.out.splitlines()[-1] == f"acquisition, {end}: so far"


# --- reading


def test_every_command_that_reads_prints_its_answer():
    assert set(SCREENS) == {one.name for one in REQUESTS if one.module == "reading"}


def test_every_screen_is_there_and_json_is_what_rest_answers(capsys, service):
    for words, part in (
        (["alpha"], "shift x       +0.2000 ± 0.0104 subap, changes ± 0.0100"),
        (["reconstructors", "list"], "cm-1   proposed    400 modes"),
        (["reconstructors", "show", "in-use"], "rtc-0: applied"),
        (["alarms", "list"], "no status: look at it"),
        (
            ["audit", "--limit", "2"],
            "1970-01-01 00:00:02Z  Ada: Stop: a\\x1b[2Jb (because: clouds)",
        ),
    ):
        assert main(words) == 0
        assert part in capsys.readouterr().out
        assert main([*words, "--json"]) == 0
        told = capsys.readouterr().out
        assert "\x1b" not in told
        assert isinstance(json.loads(told), dict)


@pytest.mark.parametrize(("accepted", "status"), [(True, 0), (False, 1)])
def test_a_refit_is_followed_until_there_is_a_reconstructor(
    capsys, service, monkeypatch, accepted, status
):
    state = MatrixState.PROPOSED if accepted else MatrixState.REFUSED
    made = ReconstructorRecord(
        id="cm-7", state=state, n_modes=300, created_ns_utc=3, reason="pole radius 0.9"
    )

    def happens():
        tracker = changed(service.now.tracker, rtc=rtc())
        (job,) = tracker.operations.refits
        event = MatrixMade(record=made, wanted=True)
        after, _ = step(tracker, event, POLICY, service.now.now_ns, job.id)
        service.now = replace(service.now, tracker=after)

    at_the_next_look(monkeypatch, happens)
    assert main(["reconstructors", "compute"]) == status
    told = capsys.readouterr().out
    assert "cm-7, 300 modes" in told
    assert "pole radius 0.9" in told


@pytest.mark.parametrize(
    "words",
    [
        ["reconstructors", "approve"],
        ["reconstructors", "rollback"],
        ["loop", "acquire"],
        ["measure", "matrix"],
    ],
)
def test_what_may_not_be_ordered_now_is_refused_before_anybody_is_asked(
    capsys, service, monkeypatch, words
):
    monkeypatch.setattr(orders, "_prompt_user", lambda *_: pytest.fail("somebody was asked"))
    service.change(stopped_because="everything was stopped by Ada (wind)")
    assert main(words) == 1
    permitted = {"matrix": "measure"}.get(words[1], words[1])
    reason = service.now.permitted[permitted].reason
    assert "Ada (wind)" in reason
    assert f"pyrcal {' '.join(words)}: {reason}" in capsys.readouterr().err
    assert service.commands == []
    main(["status"])
    shown = capsys.readouterr().out
    assert shown.count(reason) >= 1


def test_what_nobody_has_heard_of_is_a_refusal(capsys, service):
    assert main(["reconstructors", "show", "cm-9/../x y"]) == 1
    assert "cm-9/../x y" in capsys.readouterr().err
    service.change(registration=None)
    assert main(["alpha"]) == 1
    assert "no estimate yet" in capsys.readouterr().err


# --- to files


def test_history_trail_and_matrix_become_files(capsys, service, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "alpha"]) == 0
    text = (tmp_path / "alpha.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    assert [int(row["t_ns_utc"]) for row in rows] == [k * SECOND for k in range(1, 5)]
    assert float(rows[0]["filtered.rotation_deg"]) == pytest.approx(0.3)
    assert main(["export", "alpha", "--format", "jsonl", "--output", "a.jsonl"]) == 0
    lines = (tmp_path / "a.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["misfit"] for line in lines] == [1.2] * 4
    assert main(["export", "audit"]) == 0
    assert (tmp_path / "audit.csv").read_text(encoding="utf-8").count("clouds") == 2
    gain = ModeGain(mode=20, gain=0.5, sigma=0.01, scatter=0.02, t_ns_utc=SECOND)
    known, rtc = service.now.tracker.alpha.registration, service.now.tracker.loop.rtc
    service.change(registration=replace(known, optical_gains=(gain,)))
    assert main(["export", "gains"]) == 0
    rows = list(csv.DictReader((tmp_path / "gains.csv").read_text(encoding="utf-8").splitlines()))
    table = gain_table((gain,), rtc.n_modes)
    assert [k for k, row in enumerate(rows) if row["measured_utc"]] == [20]
    assert {row["t_utc"] for row in rows} == {rows[20]["measured_utc"]}
    assert [int(row["mode"]) for row in rows] == list(range(len(table.optical_gain)))
    given = [[float(row[name]) for name in ("optical_gain", "loop_gain_factor")] for row in rows]
    np.testing.assert_allclose(given, np.transpose([table.optical_gain, table.factors]))
    assert main(["export", "reconstructor-gains", "candidate", "--format", "jsonl"]) == 0
    lines = (tmp_path / "reconstructor-gains-candidate.jsonl").read_text(encoding="utf-8")
    assert len(lines.splitlines()) == 400
    kept = [
        MeasuredGains(measured=(replace(gain, t_ns_utc=k * SECOND),), n_modes=30, magnitude=8.0)
        for k in range(1, 131)
    ]
    service.archive.nights.gains = lambda first_ns, last_ns, n_most, **_: tuple(
        one for one in kept if first_ns <= one.t_ns_utc <= last_ns
    )[:n_most]
    assert main(["export", "gains-history"]) == 0
    lines = (tmp_path / "gains-history.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["t_ns_utc"] for line in lines] == [one.t_ns_utc for one in kept]
    assert main(["export", "reconstructor", "candidate"]) == 0
    np.testing.assert_array_equal(np.load(tmp_path / "reconstructor-candidate.npy"), MATRIX)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "a.jsonl", "alpha.csv", "audit.csv", "gains-history.jsonl", "gains.csv",
        "reconstructor-candidate.npy",
        "reconstructor-gains-candidate.jsonl",
    ]  # fmt: skip
    capsys.readouterr()
    assert main(["export", "audit"]) == 2
    assert "audit.csv: found a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "status", "named"),
    [
        (["alpha", "--format", "fits"], 2, "expected for alpha csv, jsonl"),
        (["reconstructor"], 2, "expected an id"),
        (["audit", "cm-1"], 2, "expected no id"),
        (["alpha", "--output", "none/a.csv"], 2, "found no folder none"),
        (["alpha", "--since", "yesterday"], 1, "since: found 'yesterday'"),
        (["reconstructor", "cm-9"], 1, "no such matrix"),
    ],
)
def test_what_cannot_be_exported_leaves_no_file(
    capsys, service, tmp_path, monkeypatch, words, status, named
):
    monkeypatch.chdir(tmp_path)
    assert main(["export", *words]) == status
    assert named in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_references_are_listed_with_their_shape_and_gain(capsys, service):
    assert main(["references", "list"]) == 0
    shape, used, proposed, *more = capsys.readouterr().out.splitlines()
    assert shape == "shape: shape-1 from ncpa.json"
    assert used.startswith("* ref-1: applied, the RTC's own references")
    assert proposed.startswith("  ref-2: proposed, 60 nm RMS, scaled with 0.60")
    assert [line.split(None, 1) for line in more] == [
        ["unexplained", "8% of the shape"],
        ["reason", "waits"],
    ]
