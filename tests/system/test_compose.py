"""The containers of ``deploy/compose.yml`` together: only where an engine can run them."""

import secrets
import shutil
import subprocess

import httpx
import pytest

from tests.support.night import wait_for
from tests.support.repository import ROOT

PROJECT = "pyrcal-test"
COMPOSE = ("docker", "compose", "--project-name", PROJECT, "-f", str(ROOT / "deploy/compose.yml"))


def engine_is_there():
    if not shutil.which("docker"):
        return False
    asked = (["docker", "info"], ["docker", "compose", "version"])
    return all(
        subprocess.run(words, capture_output=True, check=False).returncode == 0 for words in asked
    )


pytestmark = [
    pytest.mark.system,
    pytest.mark.long,
    pytest.mark.timeout(1500),
    pytest.mark.skipif(not engine_is_there(), reason="no container engine with compose is here"),
]


def run(*words):
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def composed():
    """The three containers, up: what the manual says, word for word; nothing of it is left."""
    kept = ROOT / "deploy" / "secrets"
    if kept.exists():
        pytest.skip(f"{kept} is somebody's: it would be overwritten")
    kept.mkdir(mode=0o700)
    once = ("docker", "run", "--rm", "-v", f"{PROJECT}_data:/var/lib/pyrcal", "pyrcal")
    try:
        run("docker", "build", "-t", "pyrcal", ".")
        run(*once, "key", "add", "ada", "--scope", "operate")
        key = run(*once, "key", "add", "prometheus", "--scope", "read")
        (kept / "pyrcal-key").write_text(key, encoding="utf-8")
        run(*once, "certificates", "new", "tls", "--host", "127.0.0.1")
        (kept / "grafana-password").write_text(secrets.token_hex(16), encoding="utf-8")
        run(*COMPOSE, "up", "--detach")
        yield
    finally:
        subprocess.run([*COMPOSE, "down", "--volumes"], capture_output=True, check=False)
        shutil.rmtree(kept)


def test_prometheus_scrapes_the_service_and_grafana_shows_its_board(composed):
    def healthy():
        (container,) = run(*COMPOSE, "ps", "--quiet", "pyrcal").split()
        status = run("docker", "inspect", "-f", "{{.State.Health.Status}}", container)
        return status.strip() == "healthy"

    def scraped():
        answer = httpx.get("http://127.0.0.1:9090/api/v1/query?query=pyrcal_uptime_seconds")
        return answer.is_success and answer.json()["data"]["result"]

    def board():
        answer = httpx.get("http://127.0.0.1:3000/api/dashboards/uid/pyrcal")
        return answer.is_success and answer.json()["dashboard"]["title"] == "pyrcal"

    for what in (healthy, scraped, board):
        wait_for(lambda what=what: answered(what), 120.0, what.__name__, every_s=2.0)


def answered(what):
    """Return what is found; None while nobody listens yet."""
    try:
        return what()
    except httpx.TransportError:
        return None
