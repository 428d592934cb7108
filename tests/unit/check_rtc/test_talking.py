"""What an RTC does when it is asked: each check names what is done otherwise, and agrees else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from check_rtc import moving
from check_rtc.examine import Examination, examine
from check_rtc.requirements import REQUIREMENTS, Moves, Outcome
from service.errors import LinkError
from service.wire import AckState, CommandKind, ReferencesRequest, checksum
from tests.support.pretend import N_SLOPES, Pretend

ASKING = frozenset(
    name
    for name, of in REQUIREMENTS.items()
    if of.moves is not Moves.NOTHING and name != "signatures"  # no secret is shared here
)


def asked(rtc, *names, **wish):
    """These checks of an RTC, by name."""
    wish = {"listen_s": 1.0, "consent": lambda _: True, **wish}
    only = frozenset(names) or ASKING
    return {one.name: one for one in examine(rtc.talk(), Examination(only=only, **wish))}


def test_an_rtc_that_keeps_the_contract_is_told_so_whatever_it_is_asked():
    rtc = Pretend(stage=1.0)
    checks = asked(rtc, fit_registration=rtc.fit_registration)
    assert rtc.image == pytest.approx(0.1)
    assert {one.name: one.found for one in checks.values() if one.outcome is not Outcome.OK} == {}
    assert set(checks) == ASKING
    assert "slopes lag +0.00 frames" in checks["columns"].found.replace("-0.00", "+0.00")
    assert "queried after 2." in checks["chunks"].found
    assert "1.00 and 1.00" in checks["measure"].found


def wrong(check, *words):
    assert check.outcome is Outcome.WRONG, check
    for word in words:
        assert word in check.found, check.found


# --- replies


def test_a_command_that_must_be_refused_and_is_accepted_is_named():
    rtc = Pretend(reply=lambda _, reply: replace(reply, accepted=True, reason=""))
    wrong(asked(rtc, "replies")["replies"], "a dither of mode 24 was accepted")


def test_refusals_without_their_word_late_ones_and_none_are_named():
    rtc = Pretend(reply=lambda _, reply: replace(reply, reason="no"))
    wrong(asked(rtc, "replies")["replies"], "was refused with 'no', expected missing")
    wrong(asked(Pretend(reply_s=1.5), "replies")["replies"], "took 1.5 s")
    rtc = Pretend(no_command=("loop",))
    wrong(asked(rtc, "replies")["replies"], "no answer to one gain more than modes")


def test_commands_that_are_optional_may_be_absent():
    rtc = Pretend(no_command=("ramp", "measure"))
    check = asked(rtc, "replies")["replies"]
    assert check.outcome is Outcome.OK
    assert "it offers no measure and no ramp" in check.found


def test_the_same_id_answered_otherwise_is_named():
    rtc, answers = Pretend(), iter(range(100))
    rtc.twists["reply"] = lambda _, reply: (
        replace(reply, reason=f"{reply.reason} {next(answers)}") if reply.reason else reply
    )
    wrong(asked(rtc, "replies")["replies"], "a repeated id")


# --- references


def added(command, rtc):
    """An RTC that adds an offset to the one in use."""
    slopes = (rtc.references.slopes + command.offset).astype("<f4")
    return replace(command, slopes=slopes.tobytes(), sha256=checksum(slopes))


def restarted(command, rtc):
    rtc.session = "s-references"
    return command


def louder(command, rtc):
    rtc.gains = 1.1 * rtc.gains
    return command


@pytest.mark.parametrize(
    ("twists", "words"),
    [
        ({"subtracted": lambda now: -now}, "a wrong sign"),
        ({"subtracted": lambda now: 0.7 * now}, "a wrong scale"),
        ({"subtracted": lambda now: 0.0 * now}, "named and not applied"),
        ({"references": added}, "is left after the return: it was added"),
        ({"references": lambda command, _: replace(command, ramp_s=0.0)}, "have the names"),
        ({"references": lambda command, _: replace(command, ramp_s=1.5)}, "takes 1.50 s"),
        ({"references": restarted}, "session or cm_id changed"),
        ({"references": louder}, "gains or leak changed"),
        ({"named": lambda name: name and name.rstrip("~")}, "have the names"),
        ({"named": lambda _: "mine"}, "no frame names check-references"),
        ({"status": {"reference_id": "old"}}, "the status does not name"),
        ({"denied": -1.0}, "has other numbers than were sent"),
        ({"read_back": LinkError("no answer")}, "the command is offered, and rtc/references not"),
        ({"reply": lambda _, reply: replace(reply, accepted=False, reason="range")}, "refused"),
    ],
)
def test_references_that_are_not_as_the_contract_says_are_named(twists, words):
    wrong(asked(Pretend(**twists), "references")["references"], words)


@pytest.mark.parametrize(
    ("twists", "words"),
    [
        ({"own_references": True, "read_back": LinkError("no answer")}, "unsupported: no"),
        ({"no_command": ("references",), "read_back": LinkError("no answer")}, "is optional"),
        ({"applied": LinkError("no answer")}, "no matrix in use is known"),
    ],
)
def test_who_sets_its_references_alone_is_left_alone(twists, words):
    check = asked(Pretend(**twists), "references")["references"]
    assert check.outcome is Outcome.SKIPPED
    assert words in check.found


def test_the_offset_that_was_there_is_there_afterwards():
    rtc = Pretend()
    slopes = np.full(N_SLOPES, 1e-3, "<f4")
    offset = {"slopes": slopes.tobytes(), "sha256": checksum(slopes)}
    names = {"id": "r-1", "reference_id": "ncpa", "config_id": "mask-1"}
    rtc.command(ReferencesRequest(**names, **offset, ramp_s=0.0))
    check = asked(rtc, "references")["references"]
    assert check.outcome is Outcome.OK, check.found
    np.testing.assert_array_equal(rtc.references.slopes, slopes)


# --- the dither


@pytest.mark.parametrize(
    ("twists", "words"),
    [
        ({"late_dither": 10**9}, "no frame contains it"),
        ({"late_dither": 300}, "301 after"),
        ({"dither": {"amplitude_m": (8e-9, 4e-9, 4e-9)}}, "mode 4 carries"),
        ({"dither": {"modes": (4, 5, 19)}}, "carry 4.04 nm, above all 19"),
        ({"dither": {"frequency_hz": (80.0, 150.0, 239.0)}}, "mode 5 moves at another frequency"),
        ({"never_stops": True}, "not stopped"),
        ({"no_stop_without": True}, "a stop without a dither was refused: busy"),
        ({"status": {"dither": None}}, "no status shows it"),
        ({"no_command": ("dither",)}, "no answer"),
        ({"status": {"max_dither_m": 1e-7}, "dither": {}}, ""),
    ],
)
def test_a_dither_that_is_not_as_asked_is_named(twists, words):
    check = asked(Pretend(**twists), "dither")["dither"]
    if words:
        wrong(check, words)
    else:
        assert check.outcome is Outcome.OK


def columns(change):
    def sent(header, rows):
        rows = rows.copy()
        rows[:, : header.n_slopes] = change(rows[:, : header.n_slopes])
        return [(header, rows)]

    return asked(Pretend(frames=sent), "columns")["columns"]


def test_a_dither_that_is_played_again_when_its_id_comes_again_is_named():
    rtc = Pretend()
    handle = rtc.cache.handle

    def again(command, now_s):
        reply = handle(command, now_s)
        if rtc.commands[-1] != command:
            rtc._execute(command)
        return reply

    rtc.cache = SimpleNamespace(handle=again)
    wrong(asked(rtc, "dither")["dither"], "its repeated command was carried out again")
    assert rtc.dither is None


def test_commands_without_the_dither_are_no_opposite_sign():
    def sent(header, rows):
        rows = rows.copy()
        start = header.n_slopes
        rows[:, start : start + header.n_modes] -= rows[:, start + header.n_modes :]
        return [(header, rows)]

    wrong(asked(Pretend(frames=sent), "columns")["columns"], "lack the dither")


def test_slopes_of_the_other_sign_and_slopes_that_lag_are_told_apart():
    wrong(columns(np.negative), "opposite sign")
    kept = []

    def late(slopes):
        kept.append(slopes.copy())
        before = kept[-2][-2:] if len(kept) > 1 else slopes[:2]
        return np.concatenate([before, slopes[:-2]])

    wrong(columns(late), "slopes lag +2.0")


# --- the image


def moved(**twists):
    rtc = Pretend(**twists)
    check = asked(rtc, "offload", fit_registration=rtc.fit_registration)["offload"]
    assert rtc.told_dither is None
    return rtc, check


@pytest.mark.parametrize(
    ("twists", "words"),
    [
        ({"stage": 0.4}, "moved by 0.40 of the 0.1 subap"),
        ({"stage": 0.0}, "0.00 of the 0.1 subap"),
        ({"stage": -1.0}, "opposite sign"),
        ({"stage": 2.0}, "carried out twice"),
        ({"stage": 1.0, "stands": lambda seq: seq - 300}, "start_seq is -0.3 s ahead"),
        ({"stage": 1.0, "stands": lambda seq: seq + 90_000}, "start_seq is 90.0 s ahead"),
        ({"reply": lambda _, reply: replace(reply, reason=reply.reason and "no")}, "refused: no"),
    ],
)
def test_an_image_that_does_not_move_as_asked_is_named_and_brought_back(twists, words):
    rtc, check = moved(**twists)
    wrong(check, words)
    assert rtc.image == pytest.approx(0.1)


def test_who_moves_a_repeated_demand_again_is_named():
    rtc = Pretend(stage=1.0)
    rtc.cache = SimpleNamespace(handle=lambda command, _now_s: rtc._execute(command))
    check = asked(rtc, "offload", fit_registration=rtc.fit_registration)["offload"]
    wrong(check, "moved by 2.00", "carried out twice")


def test_who_has_no_stage_and_who_does_not_answer_is_left_alone():
    for twists in ({}, {"no_command": ("offload",)}):
        assert moved(**twists)[1].outcome is Outcome.SKIPPED


def test_a_stage_that_answers_late_is_named_and_not_moved_blindly():
    rtc, check = moved(stage=1.0, reply_s=1.5)
    wrong(check, "within 1 s")
    assert [type(one).__name__ for one in rtc.commands].count("OffloadRequest") == 1


def test_where_the_image_stands_still_need_not_be_known():
    rtc, check = moved(stage=0.8, stands=lambda _seq: None)
    assert check.outcome is Outcome.OK
    assert "0.80 of the 0.1 subap" in check.found
    assert rtc.image == pytest.approx(0.1)


# --- matrices, the link and the loop


@pytest.mark.parametrize(
    ("check", "twists", "words"),
    [
        ("commit", {"mute": True}, "no acknowledgement within 6 s, though frames name it from"),
        ("commit", {"deaf": True}, "no acknowledgement within 6 s"),
        ("commit", {"swap_s": 4.0}, "more than 2 s"),
        ("commit", {"swap_s": 60.0}, "staged, and not applied within 6 s"),
        ("commit", {"frame_off": 100}, "frames name it from"),
        ("commit", {"status": {"cm_id": "own-1"}}, "within 1.5 s"),
        ("reconnect", {"new_session_on_return": True}, "s-returned"),
        ("loop", {"session_when_open": "s-1"}, "opening began no new session"),
        ("loop", {"integrator_stays": True}, "the integrator is not 0"),
        ("loop", {"session_when_closed": "s-closed"}, "closing began session s-closed"),
        ("loop", {"no_command": (CommandKind.LOOP,)}, "did not open: no answer"),
        ("measure", {"measured": -1.0}, "expected 0.2 to 3: sign or unit"),
        ("measure", {"measured": 1e-9}, "expected 0.2 to 3: sign or unit"),
        ("measure", {"stays_open": True}, "not restored"),
    ],
)
def test_an_rtc_that_does_otherwise_than_the_contract_says_is_named(check, twists, words):
    wrong(asked(Pretend(**twists), check)[check], words)


def test_an_rtc_that_applies_nothing_is_asked_once():
    checks = asked(Pretend(mute=True), "commit", "chunks", "rejection")
    assert checks["chunks"].outcome is checks["rejection"].outcome is Outcome.SKIPPED


def test_an_rtc_that_queries_chunks_and_checks_nothing_is_named_and_keeps_its_numbers():
    rtc = Pretend(takes_anything=True)
    before = rtc.matrix.copy()
    checks = asked(rtc, "commit", "rejection", "finite")
    for defect in ("wrong checksum", "other basis", "other configuration", "other system"):
        wrong(checks["rejection"], f"{defect}: applied")
    wrong(checks["rejection"], "a row too few: applied", "a used id: applied", "applied again at")
    wrong(checks["finite"], "a matrix with nan: applied", "a matrix with inf: applied")
    assert rtc.closed
    assert np.array_equal(rtc.matrix, before)


def test_a_loop_that_may_hold_nan_is_not_closed():
    """The RTC took a matrix with NaN and then nothing more: closing would play it."""
    rtc = Pretend(takes_anything=True)
    put_commit = rtc.put_commit

    def put(matrix_id, data):
        if np.isfinite(rtc.matrix).all():
            put_commit(matrix_id, data)

    rtc.put_commit = put
    wrong(asked(rtc, "finite")["finite"], "nan: applied", "THE LOOP STAYS OPEN")
    assert not rtc.closed


def test_staged_may_be_left_out():
    checks = asked(Pretend(silent_about=(AckState.STAGED,)), "commit", "chunks")
    assert {one.outcome for one in checks.values()} == {Outcome.OK}


def test_what_is_sent_is_always_the_matrix_in_use():
    rtc = Pretend()
    before, sent = rtc.matrix.copy(), []
    put_chunk = rtc.put_chunk
    rtc.put_chunk = lambda name, k, data: (sent.append((name, k, data)), put_chunk(name, k, data))
    asked(rtc, "commit", "chunks", "rejection")
    names = {name for name, _, _ in sent}
    assert len(names) >= 4
    for name in names:
        parts = {k: data for of, k, data in sent if of == name}
        for k, data in parts.items():
            numbers, start = np.frombuffer(data, "<f4"), k * len(parts[0]) // 4
            # In one of them the last bit of a number differs, in one the last row is left out.
            known = before.ravel()[start : start + len(numbers)]
            np.testing.assert_allclose(numbers, known, rtol=2e-7)


def test_an_rtc_that_measures_nothing_is_no_fault():
    check = asked(Pretend(no_command=("measure",)), "measure")["measure"]
    assert check.outcome is Outcome.SKIPPED


def test_a_measurement_that_drowns_in_noise_is_no_fault():
    check = asked(Pretend(noise=1e8), "measure")["measure"]
    assert check.outcome is Outcome.SKIPPED
    assert "too noisy" in check.found


def test_the_noise_of_a_measured_mode_is_that_of_the_modes_next_to_it():
    """The lowest modes drown, the others do not: between them the measured one shows nothing."""
    column = np.where(np.arange(60) < 20, 0.5, 0.01)
    beside = moving._neighbouring_responses(column, (8, 50), 8)
    np.testing.assert_array_equal(beside, np.full(moving.N_NOISE_MODES, 0.5))
    np.testing.assert_array_equal(
        moving._neighbouring_responses(column, (8, 50), 50), np.full(10, 0.01)
    )


# --- safety


def test_nothing_is_asked_of_an_rtc_that_is_only_listened_to():
    rtc = Pretend()
    rtc.ask = rtc.put_chunk = rtc.put_commit = rtc.close = lambda *_: pytest.fail("moved")
    assert set(asked(rtc, passive=True)) == set()


def test_what_will_be_moved_is_said_before_and_nothing_is_without_consent():
    rtc, said = Pretend(), []
    rtc.ask = rtc.put_chunk = rtc.put_commit = rtc.close = lambda *_: pytest.fail("moved")
    checks = asked(rtc, consent=lambda moved: said.extend(moved))
    assert {one.outcome for one in checks.values()} == {Outcome.SKIPPED}
    assert all("--yes" in one.found for one in checks.values())
    text = " ".join(said)
    for word in ("7 nm RMS", "modes 4, 5, 18", "same numbers", "THE LOOP IS OPENED", "20 nm RMS"):
        assert word in text


def test_the_loop_is_not_opened_unless_it_is_asked_for():
    checks = {
        o.name for o in examine(Pretend().talk(), Examination(consent=lambda _: True, listen_s=1.0))
    }
    assert "commit" in checks
    assert checks & {"loop", "measure"} == set()


def test_beside_a_service_nothing_is_asked():
    rtc = Pretend()
    rtc.other_service = True
    rtc.ask = rtc.put_chunk = lambda *_: pytest.fail("moved")
    checks = asked(rtc)
    assert {one.outcome for one in checks.values()} == {Outcome.SKIPPED}
    assert "a service drives this RTC" in checks["dither"].found


@pytest.mark.parametrize(("name", "sleeps"), [("dither", 40), ("loop", 35)])
def test_who_breaks_a_check_off_finds_mirror_and_loop_as_they_were(name, sleeps):
    rtc, left = Pretend(), iter(range(sleeps))
    sleep = rtc.sleep

    def broken_off(seconds):
        if next(left, None) is None:
            raise KeyboardInterrupt
        sleep(seconds)

    rtc.sleep = broken_off
    with pytest.raises(KeyboardInterrupt):
        asked(rtc, name)
    assert rtc.closed
    assert rtc.dither is None
    commands = [command.id for command in rtc.commands]
    assert len(commands) == 2
    assert any(word in commands[-1] for word in ("stop", "close"))
