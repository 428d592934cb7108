"""``pyrcal commission``: every criterion from an archive, a checker's result and a fit."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from check_rtc.requirements import REQUIREMENTS
from pyrcal.__main__ import main
from pyrcal.maintenance import commission
from pyrcal.maintenance.acceptance import REQUIRED_CHECKS
from service.archive import Archive, AuditEntry
from service.archive.nights import TrendSample
from service.model.misregistration import Misregistration
from service.records.registration import HistoryEntry
from tests.support.archived import MATRIX, record_of
from tests.support.night import INSTRUMENT

SECOND = 1_000_000_000
EVENING = 1_800_000_000 * SECOND
SWAP_S = 120.0
ALPHA = Misregistration(shift_x_subap=0.1, rotation_rad=0.002, magnification=1.001)
SIGMA = np.array([0.004, 0.004, 1e-4, 4e-4])

ESTIMATE = HistoryEntry(
    t_ns_utc=EVENING,
    measured=ALPHA,
    measured_sigma=2 * SIGMA,
    filtered=ALPHA,
    filtered_sigma=SIGMA,
    innovation=3.5,
    misfit=1.1,
)
SAMPLE = TrendSample(
    t_ns_utc=EVENING, alpha=ALPHA, sigma=SIGMA, residual_m=30e-9, margin=0.8, n_controlled=60
)
FIT = {
    **ALPHA.to_boundary(),
    "sigma": dict.fromkeys(ALPHA.to_boundary(), 0.002),
    "verdict": "accepted: 8 sets of modes agree",
    "gains": [1.0, 0.98, None],
    "registration": {"determined": True, "reason": ""},
    "reconstructor": {"stable_modes": 90, "n_modes": 90, "gain": 0.4, "reason": ""},
}
CHECKS = [{"check": name, "outcome": "ok", "found": "as it should"} for name in REQUIRED_CHECKS]


def at(seconds):
    return EVENING + round(seconds * SECOND)


def said(seconds, name, text=""):
    return AuditEntry(t_ns_utc=at(seconds), who="service", name=name, text=text or name)


GOOD = {
    "audit": (
        said(0, "service.ready"),
        said(SWAP_S, "reconstructor.applied", "cm-1 applied from frame 1"),
        said(SWAP_S + 4, "probation.running", "cm-1: compared"),
        said(SWAP_S + 5, "probation.passed", "cm-1: as good"),
    ),
    "estimates": tuple(replace(ESTIMATE, t_ns_utc=at(5 * k + 5)) for k in range(60)),
    "samples": tuple(replace(SAMPLE, t_ns_utc=at(15 * k)) for k in range(21)),
    "checks": CHECKS,
    "fit": FIT,
}


@pytest.fixture
def commissioned(tmp_path, monkeypatch, capsys):
    """Write an archive and the results, and return exit status, criteria and report."""
    monkeypatch.chdir(tmp_path)

    def run(*words, **changes):
        night = {**GOOD, **changes}
        with Archive(tmp_path / "data") as archive:
            archive.open()
            archive.record((), night["audit"], night["estimates"], night["samples"])
        given = []
        for option, content in (("check-rtc", {"checks": night["checks"]}), ("fit", night["fit"])):
            if content not in ({"checks": None}, None):
                (tmp_path / f"{option}.json").write_text(json.dumps(content), encoding="utf-8")
                given += [f"--{option}", f"{option}.json"]
        own = ["--data-dir", "data", "--instrument", str(INSTRUMENT), "--json"]
        status = main(["commission", *own, *given, *words])
        text = capsys.readouterr().out
        page = tmp_path / "commissioning.html"
        criteria = json.loads(text) if text else []
        return status, criteria, page.read_text(encoding="utf-8") if page.exists() else ""

    return run


def open_ones(criteria):
    return {(one["group"], one["outcome"]) for one in criteria if one["outcome"] != "pass"}


def test_a_good_night_is_accepted_in_one_file_with_figures(commissioned):
    status, criteria, page = commissioned()
    assert open_ones(criteria) == set()
    assert status == 0
    assert len(criteria) == 16
    assert "ACCEPTED: 16 of 16" in page
    assert "NOT ACCEPTED" not in page
    assert page.count("<svg") == 3  # α, gains of the fit, wavefront
    assert not re.search(r'(?:src|href)="(?!#)', page), "it needs no other file"
    for one in criteria:
        assert one["limit"]
        assert one["found"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"checks": None}, {("RTC", "missing")}),
        ({"checks": CHECKS[1:]}, {("RTC", "fail")}),
        (
            {"checks": [*CHECKS, {"check": "images", "outcome": "wrong", "found": "off"}]},
            {("RTC", "fail")},
        ),
        ({"fit": None}, {("Fit", "missing")}),
        (
            {"fit": {**FIT, "registration": {"determined": False, "reason": "sets disagree"}}},
            {("Fit", "fail")},
        ),
        ({"fit": {**FIT, "sigma": dict.fromkeys(FIT["sigma"], 0.2)}}, {("Fit", "fail")}),
        (
            {"fit": {**FIT, "reconstructor": {**FIT["reconstructor"], "stable_modes": 30}}},
            {("Fit", "fail")},
        ),
        ({"estimates": GOOD["estimates"][:5]}, {("Tracking", "fail"), ("Tracking", "missing")}),
        (
            {"estimates": tuple(replace(e, filtered_sigma=9 * SIGMA) for e in GOOD["estimates"])},
            {("Tracking", "fail")},
        ),
        (
            {"estimates": tuple(replace(e, innovation=20.0) for e in GOOD["estimates"])},
            {("Tracking", "fail")},
        ),
        (
            {"samples": tuple(replace(s, sigma=100 * SIGMA) for s in GOOD["samples"])},
            {("Tracking", "fail")},
        ),
        (
            {"samples": tuple(replace(s, margin=1.2) for s in GOOD["samples"])},
            {("Matrices", "fail")},
        ),
        (
            {"audit": (*GOOD["audit"], said(200, "probation.rolled-back", "cm-1: worse"))},
            {("Matrices", "fail")},
        ),
        (
            {"audit": GOOD["audit"][:1]},
            {("Matrices", "fail"), ("Matrices", "missing"), ("Wavefront", "missing")},
        ),
        ({"audit": (*GOOD["audit"], said(200, "mirror-silent"))}, {("Alarms", "fail")}),
        ({"audit": (*GOOD["audit"], said(200, "margin"))}, {("Alarms", "fail")}),
        (
            {
                "samples": tuple(
                    replace(s, residual_m=40e-9) if s.t_ns_utc > at(SWAP_S) else s
                    for s in GOOD["samples"]
                )
            },
            {("Wavefront", "fail")},
        ),
    ],
)
def test_what_is_not_good_fails_its_own_part_alone(commissioned, changes, expected, monkeypatch):
    monkeypatch.setattr(commission, "write_page", lambda *_: None)  # figures take a second
    status, criteria, _ = commissioned(**changes)
    assert open_ones(criteria) == expected
    assert status == 1


def test_a_serious_alarm_that_was_short_is_shown_and_passes(commissioned):
    short = (said(200, "margin"), said(203, "margin", "margin: over"))
    status, _, page = commissioned(audit=(*GOOD["audit"], *short))
    assert status == 0
    assert "<td>margin</td><td>serious</td>" in page


def test_a_disturbance_can_be_cut_off(commissioned):
    disturbed = (*GOOD["audit"], said(290, "mirror-silent"))
    until = "2027-01-15T08:04:40Z"  # 280 s after the begin
    status, _, page = commissioned(audit=disturbed)
    assert status == 1
    assert "NOT ACCEPTED: 15 of 16" in page
    status, _, page = commissioned("--until", until, audit=(), estimates=(), samples=())
    assert status == 0
    assert "2027-01-15 08:04:40 UTC" in page


@pytest.mark.parametrize(
    "words",
    [
        ("--night", "2001-01-01"),
        ("--since", "yesterday"),
        ("--since", "2027-01-15T08:00:00"),
        ("--check-rtc", "fit.json"),
        ("--fit", "check-rtc.json"),
        ("--fit", "nothing.json"),
    ],
)
def test_what_cannot_be_judged_is_refused(commissioned, words):
    status, criteria, page = commissioned(*words)
    assert (status, criteria, page) == (2, [], "")


def test_an_archive_of_another_instrument_is_refused(commissioned, tmp_path):
    with Archive(tmp_path / "data") as archive:
        archive.open()
        archive.reconstructors.store(record_of(), MATRIX, None, {"instrument": "another"})
    assert commissioned() == (2, [], "")


def test_the_required_checks_are_the_checkers_own():
    optional = {"images", "late-join", "signatures", "measure", "offload", "references"}
    assert set(REQUIRED_CHECKS) == set(REQUIREMENTS) - optional
