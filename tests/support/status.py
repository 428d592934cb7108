"""What tests of several modules share of unit.client.test_status."""

from __future__ import annotations

from service.web.views import STATE as STATE_VIEW
from service.web.views import to_json
from tests.support.api import STATE, a_snapshot
from tests.support.states import changed


def told(tracker=STATE, *, ready=True, **changes):
    """What the service would answer."""
    reason = "telemetry flows" if ready else "no RTC is there"
    snapshot = a_snapshot(changed(tracker, **changes), ready=ready, ready_reason=reason)
    return to_json(snapshot, STATE_VIEW)
