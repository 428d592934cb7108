"""What tests of several modules share of system.test_ending."""

from __future__ import annotations

from pathlib import Path

from tests.support.night import session_members
from tests.support.stranger import Stranger, small_telescope


def stranger(night):
    return Stranger(night.zenoh, *small_telescope(0.1, -0.05, 0.3, 1.003))


def maps_of(pid):
    """Return which files the process has mapped: how far its imports are."""
    try:
        return Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
    except OSError:
        return ""


def workers_of(service):
    """Return the processes of the service that have numpy: the worker and not its tracker."""
    others = (
        member for member in session_members(service.popen.pid) if member != service.popen.pid
    )
    return [member for member in others if "_multiarray_umath" in maps_of(member)]
