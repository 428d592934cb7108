"""examples/rtc.py with one violation of the contract: the RTC of somebody who forgot a rule.

``python -m tests.support.broken_rtc VIOLATION query|push ENDPOINT SYSTEM PLANT.npz``
"""

import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "rtc.py"

PUSH = {
    "queries = [session.get(f\"{root}/cm/{new['id']}?chunk={k}\") "
    'for k in range(new["n_chunks"])]': """
        keys_ = [f"{root}/cm/{new['id']}/chunk/{k}" for k in range(new["n_chunks"])]
        end_s = time.time() + 2.0
        while time.time() < end_s and not set(keys_) <= pushed.keys():
            time.sleep(0.01)
        queries = []
        for key in keys_:
            if key not in pushed:
                replies = session.get(key.replace("/chunk/", "?chunk="))
                pushed.update((key, one.ok.payload.to_bytes()) for one in replies if one.ok)
""",
    "chunks = [chunk.ok for replies in queries for chunk in replies if chunk.ok]": "",
    'b"".join(chunk.payload.to_bytes() for chunk in chunks)': (
        'b"".join(pushed.get(key, b"") for key in keys_)'
    ),
    'commits = session.declare_subscriber(f"{root}/cm/*/commit")': """pushed = {}
take = lambda sample: pushed.update({str(sample.key_expr): sample.payload.to_bytes()})
taken = session.declare_subscriber(f"{root}/cm/*/chunk/*", take)
commits = session.declare_subscriber(f"{root}/cm/*/commit")
""",
}
"""Edits of an RTC that takes published chunks, and queries those that have not come after 2 s."""

_CHECKSUM = 'hashlib.sha256(data).hexdigest() == new["sha256"]'

VIOLATIONS = {
    "checksum": (
        "rejection",
        "a wrong checksum: applied",
        {f"valid = {_CHECKSUM}": "valid = True"},
    ),
    "dtype": ("rejection", "another dtype: applied", {'"dtype": "<f4", "system"': '"system"'}),
    "shape": ("rejection", "a row too few: applied", {'"shape": [n_next, n_slopes], "d': '"d'}),
    "basis": (
        "rejection",
        "another basis: applied",
        {"expected = {**ids": 'expected = {"v": 1, "config_id": "plant-1"'},
    ),
    "configuration": (
        "rejection",
        "another configuration: applied",
        {"expected = {**ids": 'expected = {"v": 1, "basis_id": "plant-1"'},
    ),
    "system": (
        "rejection",
        "another system: applied",
        {', "system": system}\n        v': "}\n        v"},
    ),
    "used id": (
        "rejection",
        "a used id: applied",
        {' and used_ids.setdefault(new["id"], commit) == commit': ""},
    ),
    "unreadable": (
        "rejection",
        "an unreadable commit",
        {'"id": None, "sha256"': '"id": "?", "sha256"'},
    ),
    "repeated commit": (
        "rejection",
        "repeated commit: ",
        {"@functools.cache  # a repeated commit": "# a repeated commit"},
    ),
    "not finite": (
        "finite",
        "a matrix with nan: applied",
        {"valid = valid and np.isfinite(numbers).all()": ""},
    ),
    "no infinity": (
        "finite",
        "a matrix with inf: applied",
        {"np.isfinite(numbers).all()": "not np.isnan(numbers).any()"},
    ),
    "late swap": (
        "commit",
        "more than 2 s",
        {
            "            with lock:\n                matrix =": (
                "            time.sleep(3.0)\n            with lock:\n                matrix ="
            )
        },
    ),
    "read back": (
        "commit",
        "other numbers",
        {"data = matrix.astype": "data = (2 * matrix).astype"},
    ),
    "no query": (
        "chunks",
        "not queried",
        {"            if key not in pushed:": "            if False:"},
    ),
    "twice": (
        "dither",
        "carried out again",
        {"@functools.cache  # a repeated command": "# a repeated command"},
    ),
    "other content": (
        "replies",
        "another command with a used id",
        {"if used_ids.setdefault(command_id, data) != data": "if False"},
    ),
    "half rate": ("replies", "half the frame rate was accepted", {">= RATE_HZ / 2": "> RATE_HZ"}),
    "stop": (
        "dither",
        "not stopped",
        {'"stop":\n        status["dither"] = None': '"stop":\n        pass'},
    ),
    "total": ("columns", "lack the dither", {"*played_m,": "*(played_m - dither_m),"}),
    "sign": ("columns", "opposite sign", {"return [*slopes,": "return [*-slopes,"}),
    "clock": (
        "clock",
        "s ahead of UTC",
        {'{"t0_ns": start_ns': ('{"t0_ns": 3600 * 10**9 + start_ns')},
    ),
    "session": (
        "loop",
        "began no new session",
        {', status["session"] = 0.0, None, str(time.time_ns())': (" = 0.0, None")},
    ),
}
"""Check that must name each violation, words of its finding, and the edits of the example."""


def main(violation, fetch, *arguments):
    """Run the example with the edits of a violation, or none."""
    source = EXAMPLE.read_text(encoding="utf-8")
    edits = PUSH if fetch == "push" else {}
    for old, new in (edits | (VIOLATIONS[violation][2] if violation != "none" else {})).items():
        if old not in source:
            raise SystemExit(f"examples/rtc.py does not contain {old!r}")
        source = source.replace(old, new)
    sys.argv = [str(EXAMPLE), *arguments]
    exec(compile(source, str(EXAMPLE), "exec"), {"__name__": "broken"})


if __name__ == "__main__":
    main(*sys.argv[1:])
