"""What charts are drawn from: ticks, where a line breaks, numbers that have no sign in vain.

The modules of the page run in node here; tests/system/test_page.py sees them in a browser.
"""

import json
import shutil
import subprocess

import pytest

from service.web.page import FILES

NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="no node: apt install nodejs")


def told(script):
    """Return what a script prints that has the modules ``axes`` and ``words``."""
    modules = "".join(
        f"import * as {name} from '{(FILES / name).as_uri()}.js';\n" for name in ("axes", "words")
    )
    command = [NODE, "--input-type=module", "--no-warnings", "-e", f"{modules}\n{script}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


def test_every_axis_has_two_ticks_at_least_and_no_more_than_there_is_room_for():
    found = told("""
      const found = [];
      for (const middle of [0, 1, -37.2, 1004.7])
        for (const half of [0.0004, 0.01, 0.013, 0.3, 1, 2.2, 47, 1e4])
          for (const most of [2, 3, 5, 9]) {
            const [low, high] = [middle - half, middle + half];
            found.push([low, high, most, axes.ticks(low, high, most)]);
          }
      console.log(JSON.stringify(found));
    """)
    for low, high, most, ticks in found:
        assert 2 <= len(ticks) <= max(most, 5), (low, high, most, ticks)
        assert low <= ticks[0] + 1e-9 * abs(low)
        assert ticks[-1] <= high + 1e-9 * abs(high)


def test_what_rounds_to_nothing_has_no_sign():
    shown = told("""
      const shift = words.PARAMETERS[0];
      console.log(JSON.stringify([
        words.number(-0.04, 1), words.number(-0.06, 1), words.nanometres(-1e-12),
        words.rounded(-0.0004, 0.02, shift).value, words.rounded(0.0004, 0.02, shift).value,
        words.rounded(-0.03, 0.02, shift).value, words.rounded(0.03, 0.02, shift).value,
        words.rounded(0.9995, 0.002, words.PARAMETERS[3]).value,
      ]));
    """)
    assert shown == ["0.0", "-0.1", "0.0 nm", "0", "0", "-3", "+3", "1.000"]


def test_a_search_finds_lines_by_any_of_their_texts_and_what_has_led_to_them():
    line = '"mode", "mode is hold", "Rollback-20261125T023559.123456"'
    searches = ["", "  ", "HOLD mode", "rollback-20261125t02", "hold auto", "rollback-2027"]
    found = told(f"""
      const searches = {json.dumps(searches)};
      console.log(JSON.stringify(searches.map((search) => words.holds(search, {line}))));
    """)
    assert found == [True, True, True, True, False, False]


def sample(t_s, telemetry=True):
    ns = t_s * 1_000_000_000
    return {"t_ns_utc": ns, "telemetry_ns_utc": ns if telemetry else None}


def stopped(samples, starts, pairs, interval_s=15.0, old_s=120.0):
    script = f"""
      const presence = new axes.Presence({json.dumps(samples)}, {starts}, {interval_s}, {old_s});
      console.log(JSON.stringify({pairs}.map(([a, b]) => presence.stopped(a, b))));
    """
    return told(script)


def test_a_line_breaks_where_no_telemetry_came_or_nothing_ran():
    samples = [sample(t) for t in (100, 115)] + [sample(130, telemetry=False), sample(145)]
    samples += [sample(t) for t in (300, 315)]
    pairs = [[100, 115], [116, 144], [146, 299], [300, 302], [302, 316]]
    assert stopped(samples, [310], pairs) == [None, 130, 222.5, None, 310]


def test_where_nothing_was_sampled_only_a_long_pause_breaks_it():
    pairs = [[100, 160], [100, 400]]
    assert stopped([], [], pairs) == [None, 250]
    assert stopped([sample(1000)], [], pairs) == [None, 250], "it began later"


def test_the_clock_of_the_rtc_is_allowed_for_where_it_is_another():
    samples = [sample(t) for t in (100, 115, 130)]
    assert told(f"console.log(axes.behind({json.dumps(samples)}))") == 0
    for one in samples:
        one["telemetry_ns_utc"] -= 3600 * 10**9
    assert told(f"console.log(axes.behind({json.dumps(samples)}))") == 3600
