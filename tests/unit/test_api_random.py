"""Random dithers asked for over real HTTP messages, with a hand-written service behind."""

import pytest

from service.tracking.commands import StartDither
from service.tracking.products import ModeSet
from service.wire import DitherKind
from tests.unit.obedient import Obedient


@pytest.fixture
def service():
    return Obedient()


@pytest.mark.parametrize(
    ("modes", "expected"), [("all", ModeSet.ALL), (list(range(400)), tuple(range(400)))]
)
async def test_random_signs_on_hundreds_of_modes(client, service, modes, expected):
    body = {"action": "start", "kind": "binary", "modes": modes, "total_amplitude_m": 5e-9}
    response = await client.post("/v1/dither", json=body)
    assert response.status_code == 202, response.text
    assert service.commands == [
        StartDither(kind=DitherKind.BINARY, modes=expected, total_amplitude_m=5e-9)
    ]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"kind": "noise"}, "kind: found 'noise'"),
        ({"kind": "binary", "amplitude_m": 1e-9}, "no amplitude_m and no frequency_hz"),
        ({"kind": "binary", "frequency_hz": [250.0]}, "no amplitude_m and no frequency_hz"),
        ({"modes": "all"}, "at most 64 modes with sine"),
        ({"modes": list(range(65))}, "at most 64 modes with sine"),
        ({"modes": [3, 3]}, "modes without any of them twice"),
        ({"total_amplitude_m": 1e-9}, "no total_amplitude_m with sine"),
    ],
)
async def test_what_does_not_belong_together_is_refused(client, service, body, words):
    response = await client.post("/v1/dither", json={"action": "start", **body})
    assert response.status_code == 422, response.text
    assert words in response.json()["detail"]
    assert service.commands == []
