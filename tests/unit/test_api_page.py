"""What the operator's page is made of: its files, the mirror it draws, the history it shows."""

import gzip
import re
from dataclasses import replace

import numpy as np
import pytest

from service.instrument import packaged_instrument
from service.model.instrument import TabulatedModes
from service.model.misregistration import PARAMETERS
from service.web.page import FILES
from tests.support.api import ALPHA, SECOND, FakeService, a_snapshot, assert_problem, body_of, entry
from tests.support.situations import POLICY

LIMIT_BYTES = 300_000


@pytest.fixture
def service(archive):
    service = FakeService(a_snapshot(), archive=archive)
    service.instrument = packaged_instrument("flao-lbt")
    service.policy = POLICY
    return service


async def test_the_service_answers_at_the_root_of_its_name_only(client):
    """As the page on deploying says: what a proxy passes on below a path is not found."""
    for path in ("/pyrcal", "/pyrcal/", "/pyrcal/v1/state"):
        assert (await client.get(path)).status_code == 404
    assert (await client.get("/")).status_code == 200


# --- its files


async def test_the_page_is_served_with_all_it_names_and_may_do_nothing_else(client):
    page = await client.get("/")
    assert page.status_code == 200
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    named = re.findall(r'<(?:script|link)[^>]* (?:src|href)="([^"#]+)"', page.text)
    assert (await client.get("/docs")).status_code == 200, "it is where the help leads"
    assert {"dashboard/page.js", "dashboard/page.css", "dashboard/uPlot.iife.min.js"} <= set(named)
    answers = {name: await client.get(f"/{name}") for name in named}
    for name, answer in {"/": page, **answers}.items():
        assert answer.status_code == 200, name
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert answer.headers["cache-control"] == "no-cache"
    assert not re.search(r"<(script|style)>|\sstyle=|\son[a-z]+=|https?://", page.text)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("page.js", "javascript"),
        ("page.css", "text/css"),
        ("icon.svg", "image/svg+xml"),
        ("uPlot.LICENSE.txt", "text/plain"),
    ],
)
async def test_a_file_says_what_it_is_and_is_sent_once(client, name, kind):
    answer = await client.get(f"/dashboard/{name}")
    assert answer.headers["content-type"].split(";")[0].endswith(kind)
    headers = {"If-None-Match": answer.headers["etag"]}
    assert (await client.get(f"/dashboard/{name}", headers=headers)).status_code == 304


async def test_what_a_page_reads_is_packed_and_what_streams_or_is_noise_is_not(client):
    for path in ("/", "/dashboard/page.js", "/v1/mirror"):
        answer = await client.get(path)
        assert answer.headers["content-encoding"] == "gzip", path
        assert answer.headers["vary"] == "Accept-Encoding"
        plain = await client.get(path, headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        assert plain.content == answer.content
    assert "content-encoding" not in (await client.get("/v1/state")).headers


@pytest.mark.parametrize("name", ["nothing.js", "../api.py", "%2e%2e/api.py", ""])
async def test_nothing_but_its_files_is_served(client, name):
    assert_problem(await client.get(f"/dashboard/{name}"), 404, "http")


async def test_every_module_that_is_imported_is_there_and_nobody_names_another_host():
    for path in FILES.glob("*.js"):
        text = path.read_text(encoding="utf-8")
        for name in re.findall(r'(?:from |import\()"\./([^"]+)"', text):
            assert (FILES / name).exists(), (path.name, name)
        if path.name != "uPlot.iife.min.js":
            assert not re.search(r"https?://|innerHTML|eval\(", text), path.name


def test_what_is_loaded_first_is_small_and_of_the_other_pages_there_is_nothing():
    page = (FILES / "index.html").read_text(encoding="utf-8")
    found = set(re.findall(r'"dashboard/([^"]+)"', page)) | {"index.html"}
    for _ in FILES.iterdir():
        for name in [name for name in found if name.endswith(".js")]:
            text = (FILES / name).read_text(encoding="utf-8")
            found |= set(re.findall(r'from "\./([^"]+)"', text))
    assert "stream.js" in found
    assert not {"measurements.js", "history.js"} & found
    packed = [len(gzip.compress((FILES / name).read_bytes(), 4)) for name in found]
    assert sum(packed) < LIMIT_BYTES / 4, "as it travels; the rest is for what is read"


# --- the mirror


async def test_the_mirror_is_drawn_in_subapertures_about_the_centre(client):
    body = await body_of(client, "/v1/mirror")
    assert (body["n_subapertures"], body["pupil_diameter_subap"]) == (30, 30.0)
    assert (body["obscuration_ratio"], body["stop"]) == (0.11, "mirror")
    places = np.array(body["actuators"])
    assert places.shape == (663, 2)
    # thirteen rings of FLAO, the outermost at 13.5 pitches of 0.3 m; 8.22 m are 30 subapertures
    assert np.hypot(*places.T).max() == pytest.approx(13.5 * 0.3 / 8.22 * 30, abs=1e-3)
    assert body["nominal"] == dict(zip(PARAMETERS, (0.0, 0.0, 0.0, 1.0), strict=True))
    tolerance = POLICY.update_threshold
    assert body["tolerance"]["rotation_deg"] == pytest.approx(np.rad2deg(tolerance[2]))


async def test_a_mirror_seen_from_behind_is_drawn_so(client, service):
    before = (await body_of(client, "/v1/mirror"))["actuators"]
    mirror = replace(service.instrument.mirror, parity=-1)
    service.instrument = replace(service.instrument, mirror=mirror)
    after = (await body_of(client, "/v1/mirror"))["actuators"]
    np.testing.assert_allclose(after, np.array(before) * [1, -1])


async def test_of_measured_modes_nobody_knows_the_actuators(client, service):
    modes = TabulatedModes(cube=np.zeros((2, 3, 3)), pitch_m=1.0, known=np.ones((3, 3), bool))
    service.instrument = replace(service.instrument, mirror=modes)
    assert (await body_of(client, "/v1/mirror"))["actuators"] == []


# --- the history


def times(body):
    return [e["t_ns_utc"] // SECOND for e in body["entries"]]


async def history(client, **parameters):
    return await body_of(client, "/v1/alpha/history", **parameters)


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"since_ns": 2 * SECOND}, [2, 3, 4]),
        ({"until_ns": 2 * SECOND}, [0, 1, 2]),
        ({"since": "1970-01-01T00:00:01Z", "until": "1970-01-01T02:00:03+02:00"}, [1, 2, 3]),
        ({"since_ns": SECOND, "limit": 2}, [3, 4]),
        ({"since_ns": 9 * SECOND}, []),
        ({"after": SECOND, "limit": 2}, [2, 3]),
        ({"after": 4 * SECOND}, []),
    ],
)
async def test_a_part_of_the_history_is_asked_for_by_its_time(client, parameters, expected):
    assert times(await history(client, **parameters)) == expected


async def test_page_by_page_is_all_of_it_two_of_one_time_too(client, service):
    every = tuple(entry(k // 2) for k in range(20))
    service.change(history=every)
    found, after = [], 0
    while page := times(await history(client, after=after, limit=3)):
        found += page
        after = page[-1] * SECOND
    assert found == [k // 2 for k in range(2, 20)]


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"since_ns": 2, "until_ns": 1}, ["since 2 ns, until 1 ns"]),
        ({"since_ns": 2, "since": "1970-01-01T00:00:01Z"}, ["not both"]),
        ({"since": "1970-01-01T00:00:01"}, ["since"]),
        ({"since": "yesterday"}, ["since"]),
        ({"points": 3000}, ["points"]),
        ({"after": -1}, ["after"]),
        ({"sinse": 1}, ["sinse: unknown"]),
    ],
)
async def test_a_range_that_is_none_is_refused_with_what_was_found(client, parameters, words):
    answer = await client.get("/v1/alpha/history", params=parameters)
    assert_problem(answer, 422, "invalid", *words)


async def test_of_a_night_every_extreme_is_kept_however_short(client, service):
    rng = np.random.default_rng(1)
    values = np.cumsum(rng.normal(0.0, 0.01, (5000, 4)), axis=0)
    values[2500, 0] = 9.0  # a jump of a single window
    values[:, 3] = 1.0 + 1e-3 * values[:, 3]
    service.change(
        history=tuple(
            replace(entry(k), filtered=type(ALPHA).from_vector(vector))
            for k, vector in enumerate(values)
        )
    )
    body = await history(client, points=800)
    assert 200 < len(body["entries"]) <= 800
    found = np.array([list(e["filtered"].values()) for e in body["entries"]])
    found[:, 2] = np.deg2rad(found[:, 2])
    np.testing.assert_allclose(found.min(axis=0), values.min(axis=0))
    np.testing.assert_allclose(found.max(axis=0), values.max(axis=0))
    assert times(body) == sorted(times(body))


async def test_few_entries_are_not_thinned(client):
    assert times(await history(client, points=8)) == [0, 1, 2, 3, 4]


async def test_what_rest_answers_is_shown_and_tried_without_the_internet(client):
    page = await client.get("/docs")
    assert page.status_code == 200
    assert "script-src 'self';" in page.headers["content-security-policy"]
    named = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert len(named) == 3
    for name in (*named, "docs/files/LICENSE.txt", "openapi.json"):
        assert not name.startswith(("http", "//"))
        answer = await client.get(f"/{name}")
        assert answer.status_code == 200, name
    assert "openapi.json" in (await client.get("/docs/files/start.js")).text
