"""The page's buttons say what the service says: which can be used, and why one cannot.

The modules of the page run in node here; tests/system/test_page_staged.py sees them in a browser.
"""

import json
import re
import shutil
import subprocess

import pytest

from service.tracking.interlocks import ORDERS, permissions
from service.web.page import FILES
from tests.support.moments import MOMENTS

NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="no node: apt install nodejs")

FREE = {"record", "note"}
"""What is no order to the tracker: telemetry is kept and a note is written whatever runs."""


def said_of(states):
    """What the page says of each of its orders in each of these states, by its own name."""
    script = f"""
      globalThis.document = {{ querySelector: () => document, addEventListener: () => {{}} }};
      globalThis.localStorage = {{}};
      const {{ Orders, usable }} = await import('{(FILES / "orders.js").as_uri()}');
      const {{ HISTORY_ORDERS }} = await import('{(FILES / "history_orders.js").as_uri()}');
      const {{ REFERENCE_ORDERS }} = await import('{(FILES / "references.js").as_uri()}');
      const service = {{ forbidden: "", fresh: true, reconstructors: [] }};
      const orders = new Orders(service);
      orders.learn(HISTORY_ORDERS);
      orders.learn(REFERENCE_ORDERS);
      const buttons = {json.dumps(sorted(buttons()))};
      console.log(JSON.stringify({json.dumps(states)}.map((state) => {{
        service.state = state;
        return Object.fromEntries(buttons.map((name) => {{
          const button = {{ setAttribute: (key, value) => (button[key] = value) }};
          usable(button, orders.whyNot(name));
          return [name, [button["aria-disabled"], button.title]];
        }}));
      }})));
    """
    command = [NODE, "--input-type=module", "--no-warnings", "-e", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


def buttons():
    """Every order that a button, a key or a row of the page gives."""
    pages = [path.read_text(encoding="utf-8") for path in FILES.glob("*.html")]
    scripts = [path.read_text(encoding="utf-8") for path in FILES.glob("*.js")]
    found = {name for page in pages for name in re.findall(r'data-order="([\w-]+)"', page)}
    opened = r'orders\.open\("([\w-]+)"|order: "([\w-]+)"'
    found |= {one or other for text in scripts for one, other in re.findall(opened, text)}
    assert {"approve", "rollback", "give-up", "open-loop", "publish", "refit"} <= found
    return found | {"mode", "resume", "mute", "unmute"}


def test_every_order_of_the_page_is_one_of_the_service():
    refused = {name: {"allowed": False, "reason": f"{name} is refused"} for name in ORDERS}
    (said,) = said_of([{"permitted": refused}])
    assert {name for name, (disabled, _) in said.items() if disabled == "false"} == FREE
    for name in said.keys() - FREE:
        assert re.fullmatch(r"not possible now: (\w+) is refused", said[name][1])
    assert said["dither-start"][1] == "not possible now: start_dither is refused"


def test_a_button_is_disabled_for_the_reason_that_the_tracker_has():
    told = []
    for moment in MOMENTS:
        story = moment()
        now = permissions(story.state, story.policy, story.now_ns)
        told.append({name: {"allowed": p.allowed, "reason": p.reason} for name, p in now.items()})
    pairs = {"approve": "approve", "rollback": "rollback", "abort": "abort_acquisition"}
    pairs |= {"measure": "measure", "noisy": "measure_noisy", "stop": "stop_everything"}
    pairs |= {"dither-stop": "stop_dither", "open-loop": "open_loop", "give-up": "give_up"}
    for state, said in zip(told, said_of([{"permitted": one} for one in told]), strict=True):
        for button, order in pairs.items():
            reason = state[order]["reason"]
            title = f"not possible now: {reason}" if reason else ""
            assert said[button] == [str(bool(reason)).lower(), title]


def test_a_rollback_names_no_matrix_of_another_mode_of_the_sensor():
    """The service goes back to cm-1; the tag of cm-2 would never be the one it expects."""
    records = [
        {"id": "cm-0", "state": "superseded", "config_id": None},
        {"id": "cm-1", "state": "superseded", "config_id": "fine"},
        {"id": "cm-2", "state": "superseded", "config_id": "coarse"},
    ]
    script = f"""
      globalThis.document = {{ querySelector: () => document, addEventListener: () => {{}} }};
      globalThis.localStorage = {{}};
      const {{ Orders }} = await import('{(FILES / "orders.js").as_uri()}');
      const service = {{ reconstructors: {json.dumps(records)} }};
      const orders = new Orders(service);
      console.log(JSON.stringify(["fine", "coarse", "third"].map((config_id) => {{
        service.state = {{ config_id }};
        return orders.before.id;
      }})));
    """
    command = [NODE, "--input-type=module", "--no-warnings", "-e", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert json.loads(done.stdout) == ["cm-1", "cm-2", "cm-0"]
