"""What telemetry alone tells: each line names its own fault, and none of a healthy RTC's."""

from dataclasses import replace

import numpy as np
import pytest

from check_rtc.connection import ReceivedMessage, Topic
from check_rtc.examine import Examination, examine
from check_rtc.requirements import REQUIREMENTS, Outcome
from service.errors import LinkError, WireError
from service.estimation.slope_convention import SlopeConvention
from service.model.slopes import Orientation, SlopeRecipe
from tests.support.pretend import Pretend
from tests.vectors import PAGE, anchors_of


def checked(rtc, **wish):
    """Every check of an RTC that is only listened to, by name."""
    talk = rtc.talk()
    wish = {"passive": True, "listen_s": 3.0, **wish}
    return {one.name: one for one in examine(talk, Examination(**wish))}


def flagged(checks):
    return {name for name, one in checks.items() if one.outcome in {Outcome.WRONG, Outcome.SEEN}}


def test_a_healthy_rtc_is_told_so_in_every_line():
    checks = checked(Pretend())
    assert flagged(checks) == set()
    assert "leak 0.9900, gain 1 " in checks["law"].found
    assert "delay 2.00 frames" in checks["law"].found
    assert "1000 frames a second in 20 messages of up to 50" in checks["frames"].found
    assert checks["obedience"].outcome is Outcome.OK


def every(n, damage):
    """Damage every n-th batch of frames."""

    def sent(header, rows):
        return damage(header, rows) if header.seq0 // header.n % n == n - 1 else [(header, rows)]

    return sent


def with_nan(header, rows):
    rows = rows.copy()
    rows[3, 5] = np.nan
    return [(header, rows)]


def shorter(header, rows):
    return [(replace(header, n_slopes=header.n_slopes - 1), np.delete(rows, 0, axis=1))]


def starting_over(header, rows):
    return [(replace(header, seq0=header.seq0 - 5 * header.n + 1), rows)]


def renamed(**changes):
    return lambda header, rows: [(replace(header, **changes), rows)]


def beside(header, rows):
    return [(header, rows), (replace(header, session="s-other"), rows)]


DAMAGE = {
    "lost": (every(5, lambda header, rows: []), {"sequence"}),
    "twice": (every(5, lambda header, rows: [(header, rows)] * 2), {"sequence"}),
    "over": (every(9, starting_over), {"sequence", "clock"}),
    "nan": (every(7, with_nan), {"numbers"}),
    "shape": (every(7, shorter), {"sizes"}),
    "basis": (every(7, renamed(basis_id="kl-2")), {"ids"}),
    "second": (beside, {"session"}),
    "clock": (lambda h, r: [(replace(h, t0_ns=h.t0_ns + (h.seq0 > 2000) * 10**8), r)], {"clock"}),
    "hour": (lambda h, r: [(replace(h, t0_ns=h.t0_ns + 3600 * 10**9), r)], {"clock"}),
    "period": (renamed(dt_ns=2 * 10**6), {"frames", "clock"}),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_frames_are_named_by_their_line(name):
    damage, lines = DAMAGE[name]
    assert flagged(checked(Pretend(frames=damage))) == lines


def test_slopes_that_repeat_are_named_though_every_other_number_is_new():
    kept = {}

    def frozen(header, rows):
        first = kept.setdefault("slopes", rows[0, : header.n_slopes].copy())
        rows = rows.copy()
        rows[:, : header.n_slopes] = first
        return [(header, rows)]

    checks = checked(Pretend(frames=frozen))
    assert checks["numbers"].outcome is Outcome.WRONG


@pytest.mark.parametrize(
    ("told", "line"),
    [
        ({"leak": 0.9}, "law"),
        ({"delay_frames": 4.0}, "law"),
        ({"gains": (0.2,) * 16 + (0.0,) * 8}, "law"),
        ({"n_slopes": 61}, "sizes"),
        ({"n_controlled": 15, "gains": (0.4,) * 15 + (0.0,) * 9}, "matrix"),
        ({"cm_id": "another"}, "status"),
        ({"seq": 10**7}, "status"),
        ({"session": "s-9"}, "status"),
        ({"gains": (0.4,) * 24}, "status"),
        ({"frame_rate_hz": 500.0}, "frames"),
        ({"config_id": "mask-2"}, "ids"),
        ({"reference_id": "ncpa-1"}, "ids"),
    ],
)
def test_what_a_status_tells_otherwise_is_named_by_its_line(told, line):
    checks = checked(Pretend(status=told))
    assert checks[line].outcome is Outcome.WRONG, checks[line]


def test_a_mirror_that_does_not_do_what_the_loop_asks_is_named():
    def saturated(header, rows):
        rows = rows.copy()
        mode = header.n_slopes + 2
        rows[:, mode] = np.clip(rows[:, mode], -2e-10, 2e-10)
        return [(header, rows)]

    checks = checked(Pretend(frames=saturated))
    assert checks["obedience"].outcome is Outcome.WRONG
    assert "(2" in checks["obedience"].found


def test_slopes_of_the_other_sign_than_the_matrix_are_named():
    def turned(header, rows):
        rows = rows.copy()
        rows[:, : header.n_slopes] *= -1.0
        return [(header, rows)]

    assert "the other sign" in checked(Pretend(frames=turned))["law"].found


def test_messages_that_cannot_be_read_are_named_with_what_is_wrong():
    rtc = Pretend()
    rtc.sleep(1.0)
    rtc.heard.append(ReceivedMessage(topic=Topic.STATUS, key="", at_s=rtc.now_s, data=b"\xc1"))
    checks = checked(rtc)
    assert flagged(checks) == {"messages"}
    assert "range: a status is not msgpack" in checks["messages"].found


def late(rtc, wait_s):
    """Hold all messages of a second of an RTC back for so long."""
    take = rtc.take

    def taken():
        heard = take()
        return [replace(h, at_s=h.at_s + wait_s * (h.at_s > 1002.0)) for h in heard]

    rtc.take = taken
    return rtc


@pytest.mark.parametrize(("wait_s", "outcome"), [(0.3, Outcome.SEEN), (0.8, Outcome.WRONG)])
def test_frames_that_come_late_are_named_by_how_much(wait_s, outcome):
    checks = checked(late(Pretend(), wait_s))
    assert checks["delivery"].outcome is outcome
    assert f"at most {1e3 * wait_s:.0f} ms" in checks["delivery"].found
    assert "clock" not in flagged(checks)


def test_a_loop_that_stands_still_is_seen_in_its_timestamps_and_no_step_of_the_clock():
    rtc = Pretend()
    sleep = rtc.sleep

    def passing(seconds):
        if rtc.seq == 2000:
            rtc.now_s += 1.0
            rtc.t0_ns += 10**9
        sleep(seconds)

    rtc.sleep = passing
    checks = checked(rtc)
    assert checks["clock"].outcome is Outcome.SEEN
    assert "1.00 s before frame 2000" in checks["clock"].found
    assert flagged(checks) == {"clock"}


def test_a_session_that_begins_where_another_ends_is_seen_and_no_second_rtc():
    rtc = Pretend()
    sleep = rtc.sleep

    def passing(seconds):
        rtc.session = "s-1" if rtc.seq < 2000 else "s-2"
        sleep(seconds)

    rtc.sleep = passing
    assert checked(rtc)["session"].outcome is Outcome.SEEN


def test_a_token_that_goes_or_never_came_is_named():
    rtc = Pretend()
    rtc.take()
    assert checked(rtc)["connection"].outcome is Outcome.WRONG
    rtc = Pretend()
    rtc._hear(Topic.ALIVE, alive=False)
    assert checked(rtc)["connection"].outcome is Outcome.WRONG
    rtc._hear(Topic.ALIVE, alive=False)


def test_a_matrix_that_is_not_offered_is_skipped_and_one_of_a_wrong_sum_is_wrong():
    absent = checked(Pretend(applied=LinkError("no answer from the RTC on rtc/cm/applied")))
    assert absent["matrix"].outcome is absent["law"].outcome is Outcome.SKIPPED
    damaged = checked(Pretend(applied=WireError("range: the matrix has sha256 0, expected 1")))
    assert damaged["matrix"].outcome is Outcome.WRONG


def test_what_the_instrument_file_says_of_the_matrix_is_one_line():
    turned = SlopeConvention(wrong="slopes have the other sign than the instrument file says")
    checks = checked(Pretend(), compare_matrix=lambda matrix: turned)
    assert checks["orientation"].found == turned.wrong
    assert checks["orientation"].outcome is Outcome.WRONG
    found = SlopeConvention(
        found=SlopeRecipe(orientation=Orientation(sign_x=-1, sign_y=-1)), adopted=True
    )
    checks = checked(Pretend(), compare_matrix=lambda matrix: found)
    assert "sign = -1 }" in checks["orientation"].found
    pinned = checked(Pretend(), basis_id="kl-9")
    assert pinned["ids"].outcome is Outcome.WRONG


def test_an_rtc_that_is_not_there_is_no_check_but_an_error():
    rtc = Pretend()
    rtc.away = True
    rtc.take()
    with pytest.raises(LinkError, match="no RTC of system bench was seen within 5 s"):
        checked(rtc, wait_s=5.0)


def test_asking_for_one_check_makes_that_one_only():
    assert set(checked(Pretend(), only=frozenset({"clock"}))) == {"clock"}
    assert set(checked(Pretend(), only=frozenset({"clock", "loop"}))) == {"clock"}


def test_every_article_stands_in_the_contract():
    assert {article.anchor for article in REQUIREMENTS.values()} <= anchors_of(
        PAGE.read_text("utf-8")
    )
