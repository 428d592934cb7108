"""Alarms over REST: what is shown of them, and what operators do about them."""

from dataclasses import replace

from service.tracking.alarms import ALARMS, Alarm, AlarmRecord, OperatorNote, Severity
from service.tracking.operations.running import ServiceState
from tests.unit.test_api import (  # noqa: F401
    SECOND,
    body_of,
    metrics_of,
    service,
)

ADA = OperatorNote(by="Ada", reason="known", t_ns_utc=80 * SECOND)


async def test_alarms_are_those_that_last_went_unseen_or_are_muted(client, service):  # noqa: F811
    service.change(
        active=(Alarm(name="loop-open", since_ns_utc=70 * SECOND, text="open"),),
        records=(
            AlarmRecord(name="loop-open", worst=Severity.WARNING, acknowledged=ADA),
            AlarmRecord(name="margin", worst=Severity.CRITICAL, text="bad", over_ns_utc=9 * SECOND),
            AlarmRecord(name="edge-slip", muted=replace(ADA, until_ns_utc=99 * SECOND)),
        ),
    )
    body = await body_of(client, "/v1/alarms")
    (lasting,), (stale,), (muted,) = (
        body[name] for name in ("alarms", "stale_alarms", "muted_alarms")
    )
    assert (lasting["name"], lasting["severity"]) == ("loop-open", "warning")
    assert lasting["alarm_state"] == "acknowledged"
    assert (lasting["acknowledged"]["by"], lasting["acknowledged"]["reason"]) == ("Ada", "known")
    assert lasting["acknowledged"]["t_utc"] == "1970-01-01T00:01:20.000000Z"
    assert (lasting["do"], lasting["text"]) == (ALARMS["loop-open"].do, "open")
    assert (stale["severity"], stale["worst_severity"]) == (None, "critical")
    assert (stale["alarm_state"], stale["text"]) == ("stale", "bad")
    assert stale["do"] == ALARMS["margin"].do
    assert (muted["name"], muted["muted"]["until_ns_utc"]) == ("edge-slip", 99 * SECOND)
    assert body["worst_severity"] == "critical"
    state = await body_of(client, "/v1/state")
    assert {name: state[name] for name in body} == body
    assert state["operating"]["service_state"] in set(ServiceState)
    found = await metrics_of(client)
    counted = ("alarms", "alarms_stale", "alarms_muted", "alarms_unacknowledged")
    assert [found[name,] for name in counted] == [1, 1, 1, 0]
    assert found["alarms_shown", "warning"] == 1
    assert found["service_state", state["operating"]["service_state"]] == 1
