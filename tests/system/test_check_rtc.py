"""``pyrcal check-rtc`` on the simulated RTC: healthy, and with each of its faults."""

import pytest

from sim_rtc.faults import FaultKind
from tests.support.cable import free_port
from tests.support.checker import checked_beside, late_with_the_machine
from tests.support.night import INSTRUMENT, Process

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]

FLAGGED = {"wrong", "seen"}

LINES = {
    "lost@3:0.2,100": {"sequence"},
    "late@3:0.3,100": {"delivery"},
    "duplicated@3:0.3,100": {"sequence"},
    "reordered@3:0.3,100": {"sequence"},
    "nan@3:0.1,100": {"numbers"},
    "frozen@3:2": {"numbers"},
    "garbage@3:0.2,100": {"messages", "sequence"},
    "shape@3:100": {"sizes"},
    "basis@3:100": {"ids"},
    "second@3:100": {"session"},
    "clock@3": {"clock"},
    "stall@3": {"delivery"},
    "pause@3": {"clock"},
    "restart@3": {"connection", "session"},
    "open@3:2": {"session"},
    "saturation@3:20,100": {"obedience"},
    "refuse@0": {"commit"},
    "mute@0:100": {"commit"},
    "deaf@0:100": {"commit"},
    "late-swap@0:4,100": {"commit"},
    "early-ack@0:4,100": {"commit"},
    "turned-sign@0:100": {"commit"},
    "dither-lost@0:100": {"dither"},
    "dither-late@0:0.3,100": {"dither"},
    "mirror-silent@0:100": {"columns"},
    "references-scaled@0:-1,1,100": {"references"},
    "references-kept@0:1,100": {"references"},
}
"""Each fault, and the lines that name it."""

ALWAYS = [("lost@3:0.2,100", "clock@3"), ("restart@3",), ("refuse@0", "dither-lost@0:100")]
"""What goes on and what is asked for; a quarter of a minute each, so that each fault by itself is
asked for with -m slow."""


def checked(folder, *options, faults=()):
    """The simulated RTC's exit status, the outcome of each check, and all that is said."""
    given = ["--instrument", str(INSTRUMENT), "--mag", "6", "--n-controlled", "45", "--seed", "3"]
    given += [word for fault in faults for word in ("--fault", fault)]
    return checked_beside(folder, lambda at: ["sim_rtc", "--connect", at, *given], *options)


@pytest.mark.long
def test_a_healthy_rtc_keeps_the_contract_and_is_told_what_was_moved(tmp_path):
    status, checks, text = checked(tmp_path, "--yes", "--open-loop", "--seconds", "4")
    assert status == 0, text
    assert {name: one for name, one in checks.items() if one["outcome"] != "ok"} == {}
    assert len(checks) == 28
    assert "will move: loop: THE LOOP IS OPENED" in text
    assert all(one["where"].startswith("docs/rtc.md#") for one in checks.values())


@pytest.mark.long
@pytest.mark.parametrize(
    "faults",
    [*ALWAYS, *(pytest.param((one,), marks=pytest.mark.slow) for one in LINES)],
    ids=",".join,
)
def test_faults_are_named_by_their_lines_and_by_no_others(tmp_path, faults):
    lines = set().union(*(LINES[fault] for fault in faults))
    asking = lines & {"columns", "commit", "dither", "references"}
    only = ",".join(sorted(asking))
    options = ["--yes", "--seconds", "1", "--only", only] if asking else ["--passive"]
    status, checks, text = checked(tmp_path, *options, faults=faults)
    found = {name for name, one in checks.items() if one["outcome"] in FLAGGED}
    if "delivery" in found - lines and late_with_the_machine(checks["delivery"]):
        found.remove("delivery")
    assert found == lines, text
    wrong = any(one["outcome"] == "wrong" for one in checks.values())
    assert status == int(wrong)


def test_every_fault_has_its_line():
    assert {fault.partition("@")[0] for fault in LINES} == set(FaultKind)


@pytest.mark.long
def test_where_nobody_can_be_asked_nothing_is_moved(tmp_path):
    status, checks, text = checked(tmp_path, "--seconds", "1", "--only", "dither,commit")
    assert status == 0, text
    assert {one["outcome"] for one in checks.values()} == {"skipped"}
    assert "--yes" in checks["dither"]["found"]


def test_no_rtc_is_neither_right_nor_wrong(tmp_path):
    words = ["pyrcal", "check-rtc", "--wait", "1", "--listen", f"tcp/127.0.0.1:{free_port()}"]
    check = Process("check", words, tmp_path)
    assert check.ended(30.0) == 2
    assert "no RTC of system flao-lbt was seen within 1 s" in check.log
