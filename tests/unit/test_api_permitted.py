"""REST publishes which orders may be given now, and refuses the others in the same words."""

import httpx
import pytest

from service.api import create_app
from service.records.commands import Refit
from service.records.messages import as_message
from service.tracker import step
from service.tracking.interlocks import ORDERS
from tests.support.api import FakeService, a_snapshot
from tests.support.moments import MOMENTS, meant

REQUESTS = {
    "stop_everything": ("POST", "/v1/stop", {}),
    "resume": ("POST", "/v1/resume", {}),
    "mute_alarm": ("POST", "/v1/alarms/margin/mute", {"for_s": 60.0}),
    "acknowledge_alarm": ("POST", "/v1/alarms/{name}/acknowledge", {}),
    "unmute_alarm": ("POST", "/v1/alarms/{name}/unmute", {}),
    "acquire": ("POST", "/v1/acquisition", {"action": "start"}),
    "abort_acquisition": ("POST", "/v1/acquisition", {"action": "abort"}),
    "set_mode": ("PUT", "/v1/mode", {"mode": "hold"}),
    "refit": ("POST", "/v1/refit", {}),
    "start_dither": ("POST", "/v1/dither", {"action": "start"}),
    "stop_dither": ("POST", "/v1/dither", {"action": "stop"}),
    "approve": ("POST", "/v1/reconstructors/{id}/approve", {}),
    "reject": ("POST", "/v1/reconstructors/{id}/reject", {}),
    "publish": ("POST", "/v1/reconstructors/{id}/publish", {}),
    "rollback": ("POST", "/v1/rollback", {}),
    "measure": ("POST", "/v1/measurements", {}),
    "give_up": ("DELETE", "/v1/measurements/{id}", {}),
    "measure_noisy": ("POST", "/v1/noisy-matrix", {"modes": [0, 1]}),
    "set_loop": ("POST", "/v1/loop", {"leak": 0.99}),
    "open_loop": ("POST", "/v1/loop", {"loop": "open"}),
    "compensate_gains": ("POST", "/v1/loop", {"effective_gain": 0.5}),
    "ramp": ("POST", "/v1/loop/ramp", {}),
    "set_pointing": ("PUT", "/v1/pointing", {"elevation_deg": 60.0, "azimuth_deg": 0.0}),
}


class AtOneMoment(FakeService):
    """Asks the tracker what becomes of an order, and stays as it is."""

    async def submit(self, command, caller, order_id=""):
        step(self.tracker, command, self.now.policy, self.now.now_ns)
        if isinstance(command, Refit):
            return await super().submit(command, caller, order_id)
        return as_message("command", "done")


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda moment: moment.__name__)
async def test_the_state_tells_what_a_request_would_be_answered(moment):
    story = moment()
    now = a_snapshot(story.state, now_ns=story.now_ns, policy=story.policy)
    service = AtOneMoment(now)
    transport = httpx.ASGITransport(create_app(service), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        state = (await client.get("/v1/state")).json()
        permitted = state["permitted"]
        assert set(permitted) == set(ORDERS)
        for order, (method, path, body) in REQUESTS.items():
            command = meant(story.state, order)
            if command is None:
                continue
            name = getattr(command, "id", "") or getattr(command, "name", "")
            path = path.format(id=name, name=name)
            response = await client.request(method, path, json=body)
            told = response.json()
            expected = (
                (202, "") if permitted[order]["allowed"] else (409, permitted[order]["reason"])
            )
            assert (response.status_code, told.get("detail", "")) == expected, order
