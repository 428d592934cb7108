"""The page in a real browser before a staged service: every alarm, every dialog, every size."""

import time
from dataclasses import replace

import pytest

from service.records.alarms import ALARMS, OperatorNote, Severity
from service.records.commands import AcknowledgeAlarm, Approve, MuteAlarm
from service.records.products import MatrixState
from service.wire import Loop
from tests.support.api import LINK
from tests.support.browser import LAPTOP, NARROW, NEEDS_A_BROWSER, Keys, Page, a_browser
from tests.support.night import ROOT
from tests.support.staged import JUMPED, staged, state_of_now

FULL = (1920, 1080)
CRITICAL = {name: kind for name, kind in ALARMS.items() if kind.severity is Severity.CRITICAL}
LEGIBLE_PX = 36.0
"""A letter that is 5 pixels high without its stem in a picture of a quarter of the size."""

FIRST_SCREEN = 0.75
"""Share of a screen within which cause and remedy have to stand."""

pytestmark = [pytest.mark.system, pytest.mark.timeout(90), NEEDS_A_BROWSER]


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """Show one page for all tests: it follows what is staged."""
    with staged(tmp_path_factory.mktemp("staged")) as (service, url), a_browser() as driver:
        page = Page(driver, url, "flao-lbt")
        page.service = service
        page.open(LAPTOP)
        yield page


@pytest.fixture
def page(shown):
    """Give a page on a loop that is tracked, as it was loaded."""
    shown.service.now = replace(shown.service.now, tracker=state_of_now())
    shown.service.commands.clear()
    shown.resize(LAPTOP)
    shown.js("document.querySelectorAll('dialog[open]').forEach(d => d.close())")
    shown.turn("operate")
    shown.until("document.querySelector('#alarms').children.length === 0")
    shown.says("#operation", "● OPERATIONAL · TRACKING")
    return shown


def largest_px(page, within="body"):
    """Return the largest letters that are seen in a part of the page."""
    return page.js(
        f"Math.max(...[...document.querySelectorAll('{within} *')]"
        ".filter(e => e.checkVisibility() && [...e.childNodes].some(n => n.nodeType === 3"
        " && n.textContent.trim())).map(e => parseFloat(getComputedStyle(e).fontSize)))"
    )


def size_px(page, selector):
    return page.js(f"parseFloat(getComputedStyle(document.querySelector('{selector}')).fontSize)")


def bottom_px(page, selector):
    return page.js(f"document.querySelector('{selector}').getBoundingClientRect().bottom")


def proposed(service):
    """Have a reconstructor wait for an approval."""
    (*others, last) = service.now.tracker.matrices.reconstructors
    fresh = replace(last, id="cm-waits", state=MatrixState.PROPOSED, published_ns_utc=None)
    service.change(reconstructors=(*others, last, fresh))


# --- a critical alarm


def test_cause_and_remedy_of_a_critical_alarm_are_the_largest_thing_of_the_page(page):
    runbook = (ROOT / "docs" / "operate" / "runbook.md").read_text(encoding="utf-8")
    for name, kind in CRITICAL.items():
        page.service.calm()
        page.service.alarm(name, f"{kind.means}; {kind.do}")
        page.says("#critical h2", name)
        cause, remedy = (page.text(f"#critical {part}") for part in (".cause", ".remedy"))
        assert kind.means.lower().startswith(cause.lower())
        assert remedy.removeprefix("DO ") in kind.do
        assert len(cause) < 110 > len(remedy), f"{name} is read at a glance"
        for size in (LAPTOP, NARROW):
            page.resize(size)
            page.until(f"innerWidth === {size[0]}")
            letters = size_px(page, "#critical .cause")
            assert size_px(page, "#critical .remedy") == letters == largest_px(page)
            assert size != LAPTOP or letters >= LEGIBLE_PX
            assert bottom_px(page, "#critical .buttons") < FIRST_SCREEN * size[1]
            assert page.js("document.documentElement.scrollWidth") <= size[0]
        link = page.js("document.querySelector('#critical a').href")
        assert link.endswith(f"/manual/operate/runbook.html#{name}")
        assert f"\n## {name}\n" in runbook


@pytest.mark.parametrize("view", ["operate", "measurements", "history", "large"])
def test_it_is_under_the_header_on_every_view_and_nobody_is_kept_out(page, view):
    for name in ("worker-behind", "edge-slip", "loop-diverging"):
        page.service.alarm(name, f"{name} was found")
    page.turn(view)
    page.says("#critical h2", "loop-diverging")
    page.says("#critical .others", "edge-slip")
    assert page.js("document.querySelector('#critical').getBoundingClientRect().top") < 90
    page.says("#operation", "■ ERROR")
    assert page.faults_of_access() == []


def test_below_a_critical_alarm_no_card_grows_with_its_own_chart(page):
    page.service.calm()
    page.resize(LAPTOP)
    page.turn("history")
    page.service.alarm("slopes-stand", "found")
    page.says("#critical h2", "slopes-stand")
    page.turn("operate")
    heights = []
    for _ in range(8):
        heights.append(page.js("document.querySelector('#registration').offsetHeight"))
        time.sleep(1.0)
    assert len(set(heights[2:])) == 1, heights


def test_once_somebody_knows_it_gives_way_but_stays(page):
    page.service.alarm("loop-diverging", "found")
    page.until("document.querySelector('#critical').checkVisibility()")
    page.click("#critical button")
    page.dialog("Acknowledge loop-diverging")
    page.send("opening it")
    page.until("!document.querySelector('#order').open")
    (told,) = page.service.commands
    assert told == AcknowledgeAlarm(
        name="loop-diverging", severity=Severity.CRITICAL, reason="opening it"
    )
    before = bottom_px(page, "#critical")
    page.service.acknowledge("loop-diverging", OperatorNote(by="Ada", reason="", t_ns_utc=1))
    page.says("#critical", "acknowledged by Ada")
    assert bottom_px(page, "#critical") < 0.75 * before
    assert size_px(page, "#critical .cause") == largest_px(page)
    page.service.calm()
    page.until("!document.querySelector('#critical').checkVisibility()")


def test_muted_it_is_a_line_and_no_banner_and_another_one_takes_its_place(page):
    page.service.alarm("loop-diverging", "found")
    page.until("document.querySelector('#critical').checkVisibility()")
    page.service.mute(
        "loop-diverging", OperatorNote(by="Ada", reason="", t_ns_utc=1, until_ns_utc=1)
    )
    page.says("#critical", "muted by Ada until")
    page.says("#critical h2", "⊘ loop-diverging")
    for size in (LAPTOP, NARROW):
        page.resize(size)
        page.until(f"innerWidth === {size[0]}")
        assert page.js("document.querySelector('#critical').offsetHeight") < 0.2 * size[1]
        assert size_px(page, "#critical .cause") < largest_px(page)
        assert page.js("document.documentElement.scrollWidth") <= size[0]
        assert page.faults_of_access() == []
    assert not page.js("document.querySelector('#critical button').checkVisibility()")
    page.service.alarm("edge-slip", "slipped")
    page.says("#critical h2", "■ edge-slip")
    page.says("#critical .others", "also critical: loop-diverging (muted)")
    assert size_px(page, "#critical .cause") == largest_px(page)


def test_a_lost_connection_does_not_end_it(page):
    page.service.alarm("loop-diverging", "found")
    page.until("document.querySelector('#critical').checkVisibility()")
    page.offline(True)
    try:
        page.until("!document.querySelector('#lost').hidden", 20.0)
        page.says("#critical", "last known")
        page.says("#operation", "✕ NOT KNOWN")
    finally:
        page.offline(False)
    page.until("document.querySelector('#lost').hidden", 20.0)
    assert "last known" not in page.text("#critical")


def test_the_state_is_read_from_afar_by_one_key(page):
    page.service.alarm("margin", "0.97 of 0.95 anywhere within 3 sigma")
    for size in (LAPTOP, FULL, NARROW):
        page.resize(size)
        page.until(f"innerWidth === {size[0]}")
        page.press("b")
        page.says("#large .does", "DEGRADED")
        page.says("#large", "closed, 400 modes")
        page.says("#large", "◆ margin")
        assert page.js("document.documentElement.scrollWidth") <= size[0]
        assert size == NARROW or largest_px(page, "#large") >= 0.05 * size[0]
        assert page.js("document.querySelector('#large').scrollHeight") <= size[1]
        assert page.faults_of_access() == []
        page.press("b")
        page.until("document.querySelector('#operate').checkVisibility()")


def test_by_day_as_well_nobody_is_kept_out(page):
    for name in ("worker-behind", "margin", "loop-diverging"):
        page.service.alarm(name, f"{name} found")
    page.service.over("margin")
    page.until("document.querySelector('#critical').checkVisibility()")
    page.click("#scheme")
    try:
        for view in ("operate", "large"):
            page.turn(view)
            assert page.faults_of_access() == []
    finally:
        page.click("#scheme")


# --- what the colour and the symbols say


@pytest.mark.parametrize(
    ("change", "words", "tone"),
    [
        ({}, "● OPERATIONAL · TRACKING", "good"),
        ({"loop": Loop.OPEN}, "○ READY · LOOP OPEN", "busy"),
        ({"stopped_because": "Ada stopped it"}, "▲ READY · STOPPED", "warn"),
        ({"registration": None}, "◐ OPERATIONAL · α NOT KNOWN", "busy"),
        ({"rtc": None}, "○ READY", "busy"),
    ],
)
def test_only_a_loop_that_is_closed_and_followed_has_the_colour_of_that(page, change, words, tone):
    if "loop" in change:
        rtc = page.service.now.tracker.loop.rtc
        change = {"rtc": replace(rtc, **change)}
    page.service.change(**change)
    page.says("#operation", words)
    assert page.js("document.querySelector('#operation').dataset.tone") == tone
    accent = page.js(
        "getComputedStyle(document.querySelector('#operation')).color"
        " === getComputedStyle(document.querySelector('nav a[aria-current]')).borderBottomColor"
    )
    assert accent == (tone == "good")


def test_a_symbol_means_one_thing(page):
    symbols = page.driver.execute_async_script(
        "const done = arguments[0]; import('/dashboard/words.js').then(m => done(m.SYMBOLS))"
    )
    assert len(set(symbols.values())) == len(symbols) >= 12
    help_text = page.js("document.querySelector('#help-symbols + p').textContent")
    assert all(s in help_text for name, s in symbols.items() if name != "info")


# --- the list of alarms


def test_what_lasts_comes_before_what_is_over_and_the_worst_first(page):
    page.service.alarm("edge-slip", "slipped")
    page.service.over("edge-slip")
    for name in ("worker-behind", "margin", "loop-open"):
        page.service.alarm(name, f"{name} found")
    page.says("#alarms", "edge-slip")
    shown = page.js("[...document.querySelectorAll('#alarms strong')].map(e => e.textContent)")
    assert (shown[0], shown[-1]) == ("◆ margin", "◇ edge-slip")
    assert sorted(shown[1:3]) == ["▲ loop-open", "▲ worker-behind"]
    assert page.faults_of_access() == []


def test_all_are_acknowledged_at_once_each_as_it_was_seen(page):
    page.service.alarm("edge-slip", "slipped")
    page.service.over("edge-slip")
    for name in ("worker-behind", "margin"):
        page.service.alarm(name, f"{name} found")
    page.says("#unseen", "3 not acknowledged")
    page.click("#unseen button")
    page.dialog("Acknowledge 3 alarms", "◇ edge-slip (over)")
    page.send("handed over")
    page.says("#answer", "3 of 3 done")
    told = {c.name: (c.severity, c.reason) for c in page.service.commands}
    assert told == {
        "edge-slip": (Severity.CRITICAL, "handed over"),
        "worker-behind": (Severity.WARNING, "handed over"),
        "margin": (Severity.SERIOUS, "handed over"),
    }


def test_to_mute_one_asks_for_how_long_and_why(page):
    page.service.alarm("worker-behind", "busy")
    page.says("#alarms", "worker-behind")
    page.click("#alarms [data-about=mute]")
    page.dialog("Mute worker-behind")
    needed = page.js("[...document.querySelectorAll('#order label')].map(e => e.innerText)")
    assert [label.split()[-1] == "required" for label in needed[-2:]] == [True, False]
    assert needed[0].startswith("For required")
    page.send()
    page.says("#order .refused", "Not sent: For is required")
    page.press("4 hours")
    page.send()
    page.says("#order .refused", "Not sent: Reason is required")
    assert page.service.commands == []
    page.send("a slow machine")
    page.until("!document.querySelector('#order').open")
    assert page.service.commands == [
        MuteAlarm(name="worker-behind", for_s=14_400.0, reason="a slow machine")
    ]


# --- dialogs


def test_a_reason_is_typed_and_nothing_else_happens_before_it_is_sent(page):
    proposed(page.service)
    page.until("!document.querySelector('#proposal-buttons').hidden")
    page.until("document.querySelector('[data-order=approve]').ariaDisabled === 'false'")
    page.press("a")
    page.dialog("Approve cm-waits")
    assert page.js("document.activeElement.id") == "reason"
    page.press("a much better margin, h o y b 1 2 3 m r\n \n")
    page.says("#order .asked", "Ctrl+Enter sends")
    assert page.js("document.querySelector('#order').open")
    assert page.js("document.body.dataset.page") == "operate"
    assert page.service.commands == []
    assert page.faults_of_access() == []
    page.send()
    page.until("!document.querySelector('#order').open")
    (told,) = page.service.commands
    assert told == Approve(id="cm-waits", reason="a much better margin, h o y b 1 2 3 m r")


def test_what_is_typed_before_a_dialog_is_there_does_nothing(page):
    proposed(page.service)
    page.until("!document.querySelector('#proposal-buttons').hidden")
    page.until("document.querySelector('[data-order=approve]').ariaDisabled === 'false'")
    page.press("am")  # the dialog has to be read for: the m comes before it
    page.dialog("Approve cm-waits")
    assert page.js("document.body.dataset.page") == "operate"
    page.press(Keys.ESCAPE)
    page.until("!document.querySelector('#order').open")
    assert page.service.commands == []


@pytest.mark.parametrize(
    ("opener", "needed"),
    [
        ("[data-order=approve]", False),
        ("[data-order=reject]", True),
        ("[data-order=rollback]", True),
        ("[data-order=hold]", False),
        ("[data-order=acquire]", True),
        ("[data-order=dither-stop]", False),
        ("#stop", False),
    ],
)
def test_every_dialog_begins_at_the_reason_and_says_whether_it_is_needed(page, opener, needed):
    proposed(page.service)
    page.until(f"document.querySelector('{opener}').ariaDisabled === 'false'")
    page.click(opener)
    page.dialog("Ctrl+Enter")
    assert page.js("document.activeElement.id") == "reason"
    assert page.js("document.activeElement.required") == needed
    word = "required" if needed else "optional"
    assert page.text("#order label:has(#reason)").split(" ", 1)[1] == word
    page.press(" \n")
    time.sleep(0.1)
    assert page.js("document.querySelector('#order').open")
    assert page.service.commands == []


@pytest.mark.parametrize(
    "change",
    [{}, {"rtc": None}, {"registration": None}, {"stopped_because": "Ada stopped it (wind)"}],
    ids=lambda change: next(iter(change), "followed"),
)
def test_a_button_says_in_the_services_words_why_it_cannot_be_used(page, change):
    page.service.change(**change)
    shown = page.service.now.permitted
    orders = {"acquire": "acquire", "rollback": "rollback", "dither-start": "start_dither"}
    for button, order in (orders | {"dither-stop": "stop_dither"}).items():
        reason = shown[order].reason
        words = f"not possible now: {reason}" if reason else ""
        page.until(f"document.querySelector('[data-order={button}]').title === {words!r}")
        disabled = page.js(f"document.querySelector('[data-order={button}]').ariaDisabled")
        assert disabled == str(bool(reason)).lower()
    page.press("r")
    reason = shown["rollback"].reason
    if reason:
        page.says("#answer", f"Roll back is not possible now: {reason}")
    else:
        page.dialog("Roll back to")


def test_in_the_help_no_key_turns_the_page(page):
    page.press("?")
    page.until("document.querySelector('#help').open")
    page.press("mah")
    assert page.js("document.body.dataset.page") == "operate"
    assert not page.js("document.querySelector('#order').open")


# --- a laptop


def test_on_a_laptop_nothing_of_the_header_is_lost_and_no_table_is_scrolled_sideways(page):
    proposed(page.service)
    precise = [
        replace(r, sigma=0.02 * r.sigma, id=f"{r.id}-as-long-as-they-come"[:34])
        for r in page.service.now.tracker.matrices.reconstructors
    ]
    link = replace(page.service.now.link, frames_lost=27_850)
    page.service.now = replace(page.service.now, link=link)
    page.service.change(reconstructors=tuple(precise), in_use=precise[-2].id)
    for name in ("worker-behind", "margin"):
        page.service.alarm(name, f"{name} found")
    page.says("#alarm-count", "2 alarms")
    page.js("void (document.querySelector('#who').hidden = false)")
    page.js(
        "void (document.querySelector('#who').textContent = 'night.operator (operate): log out')"
    )
    for view in ("operate", "measurements", "history"):
        page.turn(view)
        page.says("#rtc", "RTC 1000 Hz, 27850 lost")
        assert page.cut_off() == []
        tops = page.js("[...document.querySelectorAll('header > div')].map(d => d.offsetHeight)")
        assert max(tops) < 36, "each row is one line"
    page.service.now = replace(page.service.now, link=LINK)
    page.open(LAPTOP)


def test_the_mirror_is_drawn_with_as_few_actuators_as_its_lines_leave_room_for(page):
    page.click("[data-factor='1']")
    page.says("#mirror .summary", "33.1 % of a subaperture")
    assert "drawn" not in page.text("#mirror .summary")
    page.service.change(registration=state_of_now(JUMPED).alpha.registration)
    page.says("#mirror .summary", "85.4 % of a subaperture")
    page.click("[data-factor='10']")
    page.says("#mirror .summary", "of 663 drawn")
    n_drawn = int(page.text("#mirror .summary").split(";")[1].split()[0])
    assert 20 < n_drawn < 60, "8.5 subapertures long each, on 30 across"
