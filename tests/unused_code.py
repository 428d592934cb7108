"""Report what the programs define and nothing calls; ``make check`` runs this module."""

import sys

import vulture

from tests.support.repository import HELD, ROOT

CALLED_FROM_ELSEWHERE = {
    "__getattr__",  # Python
    "_check_value",  # argparse
    "capture_signals",  # uvicorn
    "collect",  # prometheus_client
}
CALLERS = ("sim_rtc", "cacao_bridge", "pyrcal_studies", "benchmarks", "examples")
"""Folders whose calls count, in addition to those of the programs themselves."""


def find_unused_code() -> set[str]:
    """Return names of functions and classes without a caller.

    Decorators call routes and field checks; fields that REST shows are named in strings only.
    """
    tool = vulture.Vulture(
        ignore_decorators=["@*.get", "@*.post", "@*.put", "@*.delete", "@*_validator*"]
    )
    tool.scavenge([str(ROOT / name) for name in (*HELD, *CALLERS)])
    return {
        item.name
        for item in tool.get_unused_code()
        if {ROOT / name for name in HELD} & set(item.filename.parents)
        and item.typ not in {"variable", "attribute", "property"}
    }


if __name__ == "__main__":
    # a name that is listed above and has gone is an error, too
    if wrong := find_unused_code() ^ CALLED_FROM_ELSEWHERE:
        sys.exit(f"unused, or listed as called from elsewhere and not there: {sorted(wrong)}")
