"""The operator's page in a real browser, before a real service and a simulated RTC."""

import json
import re
import time
from pathlib import Path

import pytest

from service.web.keys import KeyFile, KeyScope
from tests.support.browser import LAPTOP, NARROW, NEEDS_A_BROWSER, WIDE, Keys, Page, a_browser
from tests.support.night import a_night, wait_for
from tests.support.pace import patience

TINY = Path(__file__).parents[1] / "data" / "tiny"
FIRST_LOAD_BYTES = 300_000

pytestmark = [pytest.mark.system, pytest.mark.long, pytest.mark.timeout(150), NEEDS_A_BROWSER]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page on a service in mode propose, with an RTC; they are shared by the tests in order."""
    with a_night(tmp_path_factory.mktemp("night")) as night, a_browser() as driver:
        night.running = night.service("propose")
        night.telescope = night.rtc()
        night.wait_for_rtc(night.telescope)
        page = Page(driver, str(night.client.base_url), "small")
        page.night = night
        yield page


def proposal(page):
    """Wait until the page shows a proposal that is not about to be replaced."""
    lasts = "!document.querySelector('#proposal').innerText.includes('a newer one follows')"
    page.until(f"!document.querySelector('#proposal-buttons').hidden && {lasts}", 60.0)


def decided_on(page):
    """Wait until a dialog asks about a proposal; return which: another may have come meanwhile."""
    page.dialog("cm-")
    return re.search(r"cm-\S+", page.text("#order h2")).group()


def test_first_load_is_small_and_of_no_other_host(page):
    page.open()
    page.says("#rtc", "1000 Hz")
    page.says("#reconstructors", "in use")
    sizes = page.js(
        "performance.getEntries().filter(e => e.transferSize !== undefined)"
        ".map(e => [e.name, e.transferSize])"
    )
    assert {name.split("/")[2] for name, _ in sizes} == {page.url.split("/")[2]}
    assert len(sizes) > 10
    assert sum(size for _, size in sizes) < FIRST_LOAD_BYTES
    logged = [line["message"] for line in page.driver.get_log("browser")]
    assert logged == []


def test_what_is_known_is_seen_with_its_sigma_and_nobody_is_kept_out(page):
    page.open()
    page.says("#operation", "TRACKING", 40.0)
    for word in ("shift x", "shift y", "rotation", "magnification", "±"):
        page.says("#registration", word)
    page.says("#mirror .summary", "% of a subaperture")
    assert page.js("document.querySelectorAll('#registration .plot canvas').length") == 4
    page.until("document.querySelectorAll('#glance .plot canvas').length === 2")
    page.says("#glance", "RMS")
    proposal(page)
    assert page.faults_of_access() == []


def test_on_a_narrow_screen_all_fits_and_state_comes_first(page):
    page.open(NARROW)
    proposal(page)
    assert page.js("document.documentElement.scrollWidth") <= NARROW[0]
    order = [
        "header",
        "#waiting",
        "#registration",
        "#mirror",
        "#loop",
        "#reconstructors",
        "#events",
    ]
    tops = [page.js(f"document.querySelector({s!r}).getBoundingClientRect().top") for s in order]
    assert tops == sorted(tops)
    assert page.faults_of_access() == []


def test_on_a_wide_screen_nothing_is_scrolled_for(page):
    page.open()
    proposal(page)
    says = "document.querySelector('#events tbody td:nth-child(4)')"
    for width, height in (WIDE, LAPTOP):
        page.resize((width, height))
        page.until(f"innerWidth === {width}")
        assert page.js("document.querySelector('header').offsetHeight") < 80, "two rows"
        assert page.js("document.documentElement.scrollWidth") <= width
        assert page.js("document.documentElement.scrollHeight") <= height
        bottom = page.js("document.querySelector('#events').getBoundingClientRect().bottom")
        assert bottom <= height
        assert page.js(f"{says}.offsetWidth") > 300, "a line of the log is read at one glance"


def test_a_click_approves_and_the_answer_is_what_the_rtc_did(page):
    page.open()
    proposal(page)
    page.click("[data-order=approve]")
    name = decided_on(page)
    page.says("#order", "pole radius")
    assert page.faults_of_access() == []
    page.click("#order [value=send]")
    page.says("#answer", "applied at frame", 20.0)
    assert page.night.state["in_use"] == name
    page.says("#provenance", f"in use: {name}")


def test_by_keys_alone_one_is_rejected_and_not_without_a_reason(page):
    page.open()
    proposal(page)
    page.enter("[data-order=reject]")
    name = decided_on(page)
    page.enter("#order [value=send]")
    assert page.js("document.querySelector('#order').open")
    assert page.night.client.get(f"/v1/reconstructors/{name}").json()["state"] == "proposed"
    page.send("not tonight\tnight operator")
    page.says("#answer", f"{name} is discarded")
    assert page.night.client.get(f"/v1/reconstructors/{name}").json()["reason"] == "not tonight"
    trail = page.night.client.get("/v1/audit").json()["entries"]
    order = next(entry for entry in reversed(trail) if entry["name"] == "Reject")
    assert (order["who"], order["channel"]) == ("night operator", "page")


def test_by_keys_alone_the_service_goes_back_and_holds(page):
    page.open()
    before = page.night.state["in_use"]
    page.until("document.querySelector('[data-order=rollback]').ariaDisabled === 'false'", 20.0)
    page.press("r")
    page.says("#order", "Mode becomes hold")
    page.send("the image was better before")
    page.says("#answer", "applied at frame", 20.0)
    assert page.night.state["in_use"] != before
    page.says("#operation", "HOLD")
    page.press("h")  # the service takes it again: a reason may be added
    page.dialog("hold")
    page.press(Keys.ESCAPE)
    page.until("!document.querySelector('#order').open")
    for key in "21":
        page.press(key)
        assert page.js(f"document.querySelector('[data-range=\"{key}\"]').ariaPressed") == "true"


def test_what_was_decided_on_a_state_that_has_changed_is_not_done(page):
    page.open()
    page.until("document.querySelector('[data-order=rollback]').ariaDisabled === 'false'", 20.0)
    page.press("r")
    page.says("#order", "under a new id")
    body = {"reason": "somebody was faster", "by": "another operator"}
    page.night.client.post("/v1/rollback", json=body).raise_for_status()
    theirs = page.night.state["in_use"]
    page.says("#provenance", f"in use: {theirs}")
    page.send("too late")
    page.says("#order .refused", "The state has changed, and nothing was sent")
    page.says("#order", f"in place of {theirs}")
    assert page.night.state["in_use"] == theirs
    page.click("#order [value=cancel]")


def load_shape(page, path, amplitude_nm):
    """Have the page load Noll's astigmatism, and the dialog say how large it is."""
    values = [0, 0, 0, 0, 0, amplitude_nm]
    path.write_text(json.dumps({"kind": "zernike", "unit": "nm", "values": values}))
    page.driver.find_element("css selector", "#held input[type=file]").send_keys(str(path))
    page.says("#order", f"{amplitude_nm} nm RMS")
    page.click("#order [value=send]")
    page.says("#answer", "is loaded", 20.0)


def test_a_shape_is_loaded_approved_refused_with_its_limit_and_taken_back(page, tmp_path):
    page.open()
    page.until("document.querySelector('#held [name=load]').ariaDisabled === 'false'", 20.0)
    page.night.client.put("/v1/mode", json={"mode": "propose"}).raise_for_status()
    load_shape(page, tmp_path / "ncpa.json", 40)
    page.says("#held .shape", "ncpa.json")
    page.until("!document.querySelector('#held .decide').hidden", 60.0)
    page.says("#held .newest", "proposed: 40 nm RMS, scaled with the optical gain")
    page.click("[data-order=approve-references]")
    page.says("#order", "In use: the RTC's own references")
    assert page.faults_of_access() == []
    page.click("#order [value=send]")
    page.says("#held .used", "40 nm RMS", 30.0)
    page.says("#held .used", "read back", 30.0)
    used = page.night.state["references"]["used"]["id"]
    load_shape(page, tmp_path / "large.json", 4000)
    page.says("#held .newest", "refused: 4", 60.0)
    page.says("#held .newest", "with at most")
    assert page.night.state["references"]["used"]["id"] == used
    page.says("#held .shape", "ncpa.json")
    page.click("[data-order=clear-shape]")
    page.send("the image was better before")
    page.says("#held .shape", "none", 30.0)
    page.says("#held .used", "the RTC's own references", 30.0)


def test_a_file_that_holds_no_shape_is_refused_before_anything_is_sent(page, tmp_path):
    page.open()
    page.until("document.querySelector('#held [name=load]').ariaDisabled === 'false'", 20.0)
    (tmp_path / "odd.json").write_text('{"values": [1, "x"]}')
    file = page.driver.find_element("css selector", "#held input[type=file]")
    file.send_keys(str(tmp_path / "odd.json"))
    page.says("#answer", "odd.json: expected a list of numbers, values; the references in use stay")
    assert not page.js("document.querySelector('#order').open")


def test_a_file_is_fitted_and_what_was_found_is_drawn(page):
    page.open()
    page.press("m")
    page.until("document.querySelector('#fits tbody tr')")  # what comes late would move the form
    for name in ("matrix", "instrument"):
        path = TINY / {"matrix": "tiny.h5", "instrument": "tiny.toml"}[name]
        page.driver.find_element("css selector", f"[name={name}]").send_keys(str(path))
    page.click("#fit [type=submit]")
    page.says("#found .verdict", "accepted", 60.0)
    page.says("#found", "rotation")
    page.until("document.querySelectorAll('#found .maps canvas').length >= 3")
    assert page.js("document.querySelector('.left canvas').width") == 24
    assert page.faults_of_access() == []
    page.resize(LAPTOP)
    assert page.cut_off() == []
    page.resize(NARROW)
    assert page.js("document.documentElement.scrollWidth") <= NARROW[0]


def test_this_night_is_seen_with_what_was_in_use_and_who_ordered_what(page):
    page.open()
    page.press("y")
    page.until("document.querySelector('#nights')")
    page.says("#nights .read", "swaps", 20.0)
    page.says("#lives", page.night.state["in_use"])
    page.says("#trail", "the image was better before")
    page.says("#trail", "another operator")
    assert page.js("document.querySelectorAll('#past .plot canvas').length") == 4
    page.resize(LAPTOP)
    assert page.cut_off() == []
    assert page.faults_of_access() == []


def test_a_night_has_trends_and_notes_and_an_older_matrix_goes_out_again(page):
    page.open()
    page.turn("history")
    page.until("document.querySelectorAll('#trends .plot canvas').length === 6", 20.0)
    page.says("#trends", "from the slopes")
    page.until("/\\d+ samples/.test(document.querySelector('#against .said').innerText)", 30.0)
    page.click("#nights [name=note]")
    page.dialog("cannot be changed")
    page.send("dome shutter moved")
    page.says("#lives", "dome shutter moved")
    page.says("#trail", "annotation: dome shutter moved")
    # The first try may have written the same note.
    notes = page.night.client.get("/v1/annotations").json()["annotations"]
    assert {note["note"] for note in notes} == {"dome shutter moved"}
    page.click("#lives .acts button")
    page.says("#compare .said", "they differ by")
    used = page.night.state["in_use"]
    older = next(one for one in page.night.ids("superseded") if one != used)
    page.click(f"#compare [name=first] [value='{older}']")
    page.says("#compare ul", older)
    page.click("#compare [name=publish]")
    page.dialog(f"in place of {used}")
    page.send("it was the better one")
    page.says("#answer", f"it is {older} again", 20.0)
    assert page.night.state["in_use"] not in {used, older}
    assert page.faults_of_access() == []
    page.resize(NARROW)
    assert page.js("document.documentElement.scrollWidth") <= NARROW[0]


def test_the_colours_are_what_the_computer_prefers_until_somebody_chooses(page):
    def prefer(value):
        scheme = {"name": "prefers-color-scheme", "value": value}
        page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})

    page.open()
    prefer("dark")
    page.until("document.documentElement.dataset.scheme === 'night'")
    prefer("light")
    page.until("document.documentElement.dataset.scheme === 'day'")
    assert page.faults_of_access() == []
    page.click("#scheme")
    assert page.js("document.documentElement.dataset.scheme") == "night"
    page.open()
    assert page.js("document.documentElement.dataset.scheme") == "night", "it is kept"
    page.js("localStorage.clear()")


def test_a_change_is_seen_within_a_second(page):
    page.open()
    for mode in ("propose", "hold", "propose"):
        began_s = time.monotonic()
        page.night.client.put("/v1/mode", json={"mode": mode}).raise_for_status()
        page.until(f"document.querySelector('#mode').value === '{mode}'", 1.0)
        assert time.monotonic() - began_s < patience(1.0)


def test_everything_is_stopped_and_released_in_two_clicks_each(page):
    page.open()
    page.click("#stop")
    page.says("#order", "Nothing is computed or sent")
    page.click("#order [value=send]")
    page.says("#operation", "STOPPED")
    page.says("#alarms", "stopped")
    assert page.night.state["stopped_because"]
    page.says("#answer", "everything was stopped")
    page.press("r")
    page.says("#answer", "Roll back is not possible now: everything was stopped")
    page.click("#stop")
    page.click("#order [value=send]")
    page.says("#answer", "released")
    page.says("#operation", "TRACKING", 20.0)


def test_once_there_are_keys_the_page_asks_for_one_and_says_why_it_may_not_order(page):
    page.open()
    keys = KeyFile(page.night.directory / "data")
    look, order = keys.add("looks", KeyScope.READ), keys.add("orders", KeyScope.OPERATE)

    def log_in(secret):
        page.until("document.querySelector('#login').open")
        field = page.driver.find_element("css selector", "#login-key")
        field.clear()
        field.send_keys(secret)
        page.click("#login [type=submit]")

    page.says("#lost", "requires a key")
    log_in("pyrcal_guess")
    page.says("#login", "found a key that is none")
    assert page.faults_of_access() == []
    log_in(look)
    page.until("document.querySelector('#lost').hidden")
    page.says("#who", "looks (read)")
    page.press("h")
    page.says("#answer", "Hold is not possible now: key looks is read-only")
    assert "key looks is read-only" in page.js("document.querySelector('#stop').title")
    keys.revoke("looks")
    log_in(order)
    page.until("document.querySelector('#lost').hidden")
    page.press("h")
    page.click("#order [value=send]")
    page.says("#answer", "mode is hold")
    assert page.js("document.cookie") == "", "no script can read it"
    headers = {"Authorization": f"Bearer {order}"}

    def told():
        trail = page.night.client.get("/v1/audit", headers=headers).json()["entries"]
        return {(e["name"], e["who"], e["address"], e["channel"]) for e in trail}

    # the answer is written down after it was given
    wait_for(lambda: ("SetMode.answered", "orders", "127.0.0.1", "page") in told(), 5.0, "its line")
    assert ("request.wrong-key", "127.0.0.1", "127.0.0.1", "page") in told()
    page.click("#who")
    page.until("document.querySelector('#login').open")
    keys.path.unlink()
    page.open()
    assert page.js("document.querySelector('#who').hidden")


def test_two_rtcs_at_once_are_a_banner_that_says_what_to_do_until_one_is_gone(page):
    page.open(LAPTOP)
    other = page.night.rtc(seed=4)
    page.until("document.querySelector('#critical').checkVisibility()", 20.0)
    page.says("#critical", "second-rtc")
    page.says("#critical .remedy", "Stop one of them")
    assert page.js("parseFloat(getComputedStyle(document.querySelector('.cause')).fontSize)") > 36
    page.says("#operation", "■ ERROR")
    other.kill()
    page.until("!document.querySelector('#critical').checkVisibility()", 20.0)
    page.says("#alarms", "◇ second-rtc")


def without_rtc(page):
    """Open the page on a service whose RTC has been killed, by this test or the one before."""
    page.open()
    page.night.telescope.kill()
    page.says("#alarms", "rtc-vanished", 10.0)


def test_an_rtc_that_is_gone_is_seen_with_what_to_do(page):
    without_rtc(page)
    page.says("#alarm-count", "1 alarm")
    page.says("#rtc", "RTC not connected")
    page.says("#operation", "DEGRADED")
    assert page.js("document.querySelector('#loop').classList.contains('old')")
    page.says("#live", "rtc-vanished")
    # of an order that needs nothing but an RTC
    assert "no RTC is there" in page.js("document.querySelector('[data-order=acquire]').title")
    assert page.faults_of_access() == []


def test_an_alarm_is_acknowledged_and_muted_also_by_keys_alone(page):
    without_rtc(page)
    vanished = "#alarms [data-name=rtc-vanished]"
    page.enter(f"{vanished}[data-about=acknowledge]")
    page.dialog("restart it")
    page.send("power is off\tAda")
    page.says("#answer", "rtc-vanished is acknowledged; it stays until it is over")
    page.says("#alarms", "acknowledged by Ada")
    page.says("#alarms", "power is off")
    assert page.faults_of_access() == []
    page.click(f"{vanished}[data-about=mute]")
    page.says("#order", "stays forbidden")
    page.driver.find_element("css selector", "#order [name=for_s]").send_keys("an hour")
    page.js("document.querySelector('#reason').focus()")
    page.send("until noon")
    page.says("#alarms", "muted by Ada until")
    page.says("#alarm-count", "1 muted")
    assert page.faults_of_access() == []
    (muted,) = page.night.client.get("/v1/alarms").json()["muted_alarms"]
    assert (muted["name"], muted["muted"]["reason"]) == ("rtc-vanished", "until noon")
    page.click(f"{vanished}[data-about=unmute]")
    page.click("#order [value=send]")
    page.says("#alarm-count", "1 alarm")


def test_a_service_that_is_gone_is_a_banner_and_its_return_the_end_of_it(page):
    page.open()
    page.night.running.kill()
    page.says("#lost", "CONNECTION LOST", 10.0)
    page.says("#operation", "NOT KNOWN")
    assert page.faults_of_access() == []
    page.night.running = page.night.service("propose")
    page.until("document.querySelector('#lost').hidden", 15.0)
    page.says("#operation", "READY")
