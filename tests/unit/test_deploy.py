"""What observatories install from ``deploy/``: the unit, its settings."""

import re
import shutil
import subprocess
import tomllib
from importlib import metadata

import pytest
import yaml
from packaging.requirements import Requirement

from service.config import load_settings
from tests.support.deploy import DEPLOY, SERVICE, UNIT
from tests.support.repository import ROOT

SETTINGS = (DEPLOY / "pyrcal.toml").read_text(encoding="utf-8")


COMPOSE = yaml.safe_load((DEPLOY / "compose.yml").read_text(encoding="utf-8"))


def test_the_settings_are_read_and_write_where_the_unit_lets_them():
    settings = load_settings(DEPLOY / "pyrcal.toml", {})
    assert str(settings.service.data_dir) == f"/var/lib/{SERVICE['StateDirectory'][0]}"
    assert str(settings.service.cache_dir) == f"/var/cache/{SERVICE['CacheDirectory'][0]}"
    assert settings.service.mode == "propose"
    assert settings.api.host == "127.0.0.1"


def test_every_line_that_is_commented_out_is_read_too(tmp_path):
    path = tmp_path / "pyrcal.toml"
    text = SETTINGS.replace("tcp/127.0.0.1:7447", "tls/0.0.0.0:7447")
    path.write_text(re.sub(r"^#   ", "", text, flags=re.MULTILINE), encoding="utf-8")
    assert len(tomllib.loads(path.read_text("utf-8"))["zenoh"]) == 3
    settings = load_settings(path, {})
    assert str(settings.zenoh.tls.key) == "/etc/pyrcal/tls/service-key.pem"
    assert settings.dither.avoid_hz == (13.0, 22.5)


def test_what_is_said_to_be_a_default_is_one(tmp_path):
    bare = load_settings(None, {})
    for table, text in re.findall(
        r"^\[(\w+)\]\n(.*?)(?=^\[|\Z)", SETTINGS, re.DOTALL | re.MULTILINE
    ):
        if table in {"dither", "tracking", "control", "compute", "archive"}:
            said = tomllib.loads("".join(re.findall(r"^#   (\w.*\n)", text, re.MULTILINE)))
            for key in said.keys() - {"avoid_hz"}:
                assert said[key] == getattr(getattr(bare, table), key), (table, key)


def test_the_unit_waits_for_the_service_to_say_it_has_started_and_feeds_on_its_word():
    assert SERVICE["Type"] == ["notify"]
    assert 0 < int(SERVICE["WatchdogSec"][0]) <= 120
    assert SERVICE["ExecStart"] == ["/opt/pyrcal/bin/pyrcal run --config /etc/pyrcal/pyrcal.toml"]
    assert SERVICE["Restart"] == ["always"]
    assert SERVICE["RestartPreventExitStatus"] == ["2"]  # a refusal, which no restart mends


def test_the_unit_leaves_the_service_neither_rights_nor_files_of_others():
    assert SERVICE["CapabilityBoundingSet"] == SERVICE["AmbientCapabilities"] == [""]
    assert SERVICE["ProtectSystem"] == ["strict"]
    assert SERVICE["NoNewPrivileges"] == ["true"]
    assert SERVICE["User"] == ["pyrcal"]
    assert SERVICE["IPAddressDeny"] == ["any"]


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd is not installed")
def test_systemd_reads_the_unit_and_finds_little_exposed(tmp_path):
    path = tmp_path / "pyrcal.service"
    path.write_text(UNIT.replace("/opt/pyrcal/bin/pyrcal", shutil.which("true")), encoding="utf-8")
    words = ["systemd-analyze", "--no-pager"]
    read = subprocess.run([*words, "verify", path], capture_output=True, text=True, check=False)
    assert (read.returncode, read.stderr) == (0, "")
    judged = subprocess.run(
        [*words, "security", "--offline=true", path], capture_output=True, text=True, check=True
    )
    found = re.search(r"Overall exposure level for pyrcal.service: ([\d.]+)", judged.stdout)
    assert float(found[1]) < 2.0


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_a_container_writes_its_volumes_has_no_rights_and_is_reached_from_here_alone(name):
    service = COMPOSE["services"][name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert service["image"] == "pyrcal" or re.search("@sha256:[0-9a-f]{64}$", service["image"])
    assert set(service.get("secrets", ())) <= COMPOSE["secrets"].keys()
    for volume in service["volumes"]:
        source, _, target = volume.partition(":")
        here = (DEPLOY / source).exists() and target.endswith(":ro")
        assert here or source in COMPOSE["volumes"], volume


def test_prometheus_and_grafana_find_each_other_and_the_service():
    scraped = yaml.safe_load((DEPLOY / "prometheus-compose.yml").read_text(encoding="utf-8"))
    (job,) = scraped["scrape_configs"]
    assert job["job_name"] == "pyrcal"  # the rules of alerts.yml ask for it
    host, _, port = job["static_configs"][0]["targets"][0].partition(":")
    assert port == COMPOSE["services"][host]["ports"][0].rpartition(":")[2]
    assert (
        host
        in tomllib.loads(
            "hosts = " + COMPOSE["services"][host]["environment"]["PYRCAL_API__ALLOWED_HOSTS"]
        )["hosts"]
    )
    secret = job["authorization"]["credentials_file"].removeprefix("/run/secrets/")
    assert secret in COMPOSE["services"]["prometheus"]["secrets"]
    provisioning = DEPLOY / "grafana" / "provisioning"
    sources = yaml.safe_load((provisioning / "datasources" / "prometheus.yml").read_text("utf-8"))
    host = re.fullmatch(r"http://(\w+):9090", sources["datasources"][0]["url"])[1]
    assert host in COMPOSE["services"]
    boards = yaml.safe_load((provisioning / "dashboards" / "pyrcal.yml").read_text("utf-8"))
    folder = boards["providers"][0]["options"]["path"]
    assert any(f":{folder}/" in volume for volume in COMPOSE["services"]["grafana"]["volumes"])


@pytest.mark.skipif(not shutil.which("docker-compose"), reason="docker-compose is not installed")
def test_compose_reads_its_file():
    command = ["docker-compose", "-f", DEPLOY / "compose.yml", "config", "--quiet"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def locked(name):
    """Return the packages of a lock file: their versions, and whether each has its hashes."""
    text = (DEPLOY / name).read_text(encoding="utf-8")
    return dict(
        re.findall(r"^([\w.-]+)==(\S+).*\\\n +--hash=sha256:[0-9a-f]{64}", text, re.MULTILINE)
    )


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


CONSTRAINTS = {
    normal(name): version
    for name, version in re.findall(
        r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE
    )
}


@pytest.mark.parametrize("name", ["requirements.lock", "build.lock"])
def test_a_lock_file_has_the_versions_that_were_tested_and_the_hash_of_each(name):
    found = locked(name)
    assert len(found) == len(
        re.findall("^[a-zA-Z]", (DEPLOY / name).read_text("utf-8"), re.MULTILINE)
    )
    only_elsewhere = {"colorama"}  # on Windows alone
    assert {key: version for key, version in found.items() if key not in only_elsewhere} == {
        key: CONSTRAINTS.get(normal(key)) for key in found if key not in only_elsewhere
    }


def test_the_lock_file_has_all_that_the_program_needs():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = {normal(re.match(r"[\w.-]+", one)[0]) for one in project["dependencies"]}
    found = {normal(name) for name in locked("requirements.lock")}
    assert needed <= found
    for name in found:
        for asked in metadata.requires(name) or ():
            requirement = Requirement(asked)
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                assert normal(requirement.name) in found, (name, asked)
