"""What observatories install from ``deploy/``: the unit, its settings."""

import re
import shutil
import subprocess
import tomllib

import pytest

from service.config import load_settings
from tests.unit.test_house import ROOT

DEPLOY = ROOT / "deploy"
UNIT = (DEPLOY / "pyrcal.service").read_text(encoding="utf-8")
SETTINGS = (DEPLOY / "pyrcal.toml").read_text(encoding="utf-8")


def unit_table(name):
    """Return a section of the unit: every key with its values."""
    found = {}
    for line in UNIT.partition(f"[{name}]\n")[2].partition("\n[")[0].splitlines():
        if line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


SERVICE = unit_table("Service")


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
