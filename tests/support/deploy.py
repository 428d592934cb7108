"""What tests of several modules share of unit.test_deploy."""

from __future__ import annotations

from tests.support.repository import ROOT

DEPLOY = ROOT / "deploy"


UNIT = (DEPLOY / "pyrcal.service").read_text(encoding="utf-8")


def unit_table(name):
    """Return a section of the unit: every key with its values."""
    found = {}
    for line in UNIT.partition(f"[{name}]\n")[2].partition("\n[")[0].splitlines():
        if line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


SERVICE = unit_table("Service")
