"""The link secured: what the tables of the settings make of zenoh's own."""

import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta

import pytest
import zenoh

from service.config import load_settings
from service.config.link_tables import (
    AccessTable,
    ZenohTable,
    link_security,
    read_certificate,
    read_link_tables,
    secret_of,
)
from service.errors import ConfigurationError
from service.wire import Keys
from service.wire.access import LinkRole, LinkSecurity, Rights, access_control, list_rights


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    certificates("new", folder, "--host", "localhost,192.168.7.10", "--days", "30")
    return folder


def certificates(*words):
    command = [sys.executable, "-m", "pyrcal", "certificates", *map(str, words)]
    return subprocess.run(command, check=True, capture_output=True, text=True)


# --- pyrcal certificates


def test_certificates_are_made_for_each_role_and_their_keys_are_private(folder):
    for role in LinkRole:
        assert read_certificate(folder / f"{role}.pem", "").name == role
        assert (folder / f"{role}-key.pem").stat().st_mode & 0o077 == 0
    ends = datetime.fromtimestamp(read_certificate(folder / "rtc.pem", "").ends_s, UTC)
    assert timedelta(days=29) < ends - datetime.now(UTC) <= timedelta(days=30)


def test_made_again_the_authority_is_the_same_and_the_rest_is_new(tmp_path):
    certificates("new", tmp_path)
    ca, rtc = (tmp_path / "ca.pem").read_bytes(), (tmp_path / "rtc.pem").read_bytes()
    certificates("new", tmp_path)
    assert (tmp_path / "ca.pem").read_bytes() == ca
    assert (tmp_path / "rtc.pem").read_bytes() != rtc


def test_what_is_shown_is_whose_they_are_and_until_when(folder):
    lines = certificates("show", folder).stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["pyrcal", "rtc", "service", "viewer"]
    assert all(f"{datetime.now(UTC).year}" in line or "until" in line for line in lines)


def test_the_files_that_are_written_are_settings_and_zenohs_own(folder):
    service = load_settings(folder / "service.toml", {}).zenoh
    assert service.listen == ("tls/localhost:7447",)
    rtc = read_link_tables(folder / "rtc.toml")
    assert rtc.connect == service.listen
    config = zenoh.Config.from_file(str(folder / "viewer.json5"))
    assert json.loads(config.get_json("connect/endpoints")) == ["tls/localhost:7447"]


def test_service_and_rtc_may_share_a_secret_that_a_viewer_does_not_get(folder, tmp_path):
    for role in ("service", "rtc"):
        path = tmp_path / f"{role}.toml"
        path.write_text((folder / f"{role}.toml").read_text().replace("# ", ""))
        assert len(secret_of(read_link_tables(path))) == 64
    assert "signing" not in (folder / "viewer.toml").read_text()
    assert (folder / "signing.key").stat().st_mode & 0o077 == 0
    assert secret_of(read_link_tables(folder / "rtc.toml")) is None


# --- what zenoh is told


def test_without_tables_zenoh_is_told_nothing():
    assert link_security(load_settings(None, {}).zenoh, "bench") == LinkSecurity()


def test_a_router_asks_for_certificates_and_controls_access_by_their_names(folder):
    told = link_security(load_settings(folder / "service.toml", {}).zenoh, "bench").zenoh
    assert told["transport/link/tls"]["enable_mtls"]
    assert told["access_control"]["default_permission"] == "deny"
    assert {"id": "rtc", "cert_common_names": ["rtc"]} in told["access_control"]["subjects"]


def test_a_client_shows_its_certificate_and_controls_nothing(folder):
    told = link_security(read_link_tables(folder / "rtc.toml"), "bench").zenoh
    assert list(told) == ["transport/link/tls"]


def test_all_that_zenoh_is_told_it_takes(folder):
    config = zenoh.Config()
    told = link_security(load_settings(folder / "service.toml", {}).zenoh, "bench").zenoh
    for key, value in told.items():
        config.insert_json5(key, json.dumps(value))
    assert json.loads(config.get_json("access_control"))["enabled"]


def test_a_role_without_names_has_no_subject_and_no_rule():
    names = {LinkRole.RTC: ("a", "b"), LinkRole.SERVICE: (), LinkRole.VIEWER: ()}
    control = access_control(Keys("bench"), names, subject_kind="usernames")
    assert control["subjects"] == [{"id": "rtc", "usernames": ["a", "b"]}]
    assert all(rule["id"].startswith("rtc-") for rule in control["rules"])


def test_only_a_service_puts_matrices_and_commands_and_only_an_rtc_telemetry():
    keys = Keys("bench")
    rights = list_rights(keys)
    assert [role for role in rights if keys.all_commits in rights[role].puts] == ["service"]
    assert [role for role in rights if keys.command("*") in rights[role].queries] == ["service"]
    for key in (keys.frames, keys.status, keys.acknowledgement):
        assert [role for role in rights if key in rights[role].puts] == ["rtc"]
    viewer = rights[LinkRole.VIEWER]
    nothing = Rights()
    assert (viewer.puts, viewer.answers, viewer.holds) == (
        nothing.puts,
        nothing.answers,
        nothing.holds,
    )


def test_nobody_may_delete():
    names = {role: (str(role),) for role in LinkRole}
    control = access_control(Keys("bench"), names, subject_kind="usernames")
    assert not [rule for rule in control["rules"] if "delete" in rule["messages"]]


# --- who may come from other machines


@pytest.mark.parametrize(
    "listen",
    [
        "tcp/0.0.0.0:7447",
        "tcp/[::]:7447",
        "tcp/ao-pc:7447",
        "udp/10.0.0.5:7447",
        "tcp/:7447",
        "tcp/0.0.0.0:7447#iface=eth0",
        "ws/[fe80::1]:7447",
        "tcp/127.0.0.1.example.org:7447",
    ],
)
def test_where_other_machines_can_reach_it_nothing_is_open(tmp_path, listen):
    found = refusal(tmp_path, f'[zenoh]\nlisten = ["tcp/127.0.0.1:7447", "{listen}"]\n')
    assert f"found listen {listen}, which other machines can reach, without [zenoh.tls]" in found
    assert "pyrcal certificates new FOLDER --host NAME" in found


@pytest.mark.parametrize(
    "listen", ["tcp/127.0.0.1:7447", "tcp/localhost:0", "tcp/[::1]:7447", "unixsock-stream//run/a"]
)
def test_on_loopback_nothing_is_asked_for(listen):
    assert load_settings(None, {}, {"zenoh.listen": [listen]}).zenoh.listen == (listen,)


def test_the_command_line_and_the_environment_are_held_to_it_too():
    with pytest.raises(ConfigurationError, match="which other machines can reach"):
        load_settings(None, {}, {"zenoh.listen": ["tcp/0.0.0.0:7447"]})
    with pytest.raises(ConfigurationError, match="which other machines can reach"):
        load_settings(None, {"PYRCAL_ZENOH__LISTEN": '["tcp/0.0.0.0:7447"]'})
    with pytest.raises(ConfigurationError, match="which other machines can reach"):
        read_link_tables(None, listen="tcp/0.0.0.0:7447")


def test_with_passwords_alone_other_machines_are_not_let_in(tmp_path):
    users = '[zenoh.users]\nname = "service"\npassword_file = "own"\nfile = "users"\n'
    found = refusal(tmp_path, f'[zenoh]\nlisten = ["tcp/0.0.0.0:7447"]\n{users}')
    assert "without [zenoh.tls]" in found


def test_certificates_let_other_machines_in(folder):
    text = '[zenoh]\nlisten = ["tls/0.0.0.0:7447"]\n' + tls(folder)
    (folder / "all.toml").write_text(text)
    assert load_settings(folder / "all.toml", {}).zenoh.listen == ("tls/0.0.0.0:7447",)


def test_who_accepts_the_risk_says_so_in_a_name_that_nobody_writes_by_accident():
    env = {"PYRCAL_ZENOH__LISTEN": '["tcp/0.0.0.0:7447"]'}
    env["PYRCAL_ZENOH__ANYONE_MAY_COMMAND_THE_MIRROR"] = "true"
    assert load_settings(None, env).zenoh.listen == ("tcp/0.0.0.0:7447",)


# --- what is refused


def refusal(folder, text, name="bad.toml"):
    path = folder / name
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        link_security(load_settings(path, {}).zenoh, "bench")
    message = str(caught.value)
    assert "\n" not in message
    return message


def tls(folder, **files):
    names = {"ca": "ca.pem", "certificate": "service.pem", "key": "service-key.pem"} | files
    return "[zenoh.tls]\n" + "".join(f'{k} = "{folder / v}"\n' for k, v in names.items())


def test_beside_certificates_there_is_no_way_without(folder):
    found = refusal(folder, '[zenoh]\nlisten = ["tcp/127.0.0.1:7447"]\n' + tls(folder))
    assert "found tcp/127.0.0.1:7447 together with [zenoh.tls], expected tls/HOST:PORT" in found


def test_a_secret_that_could_be_guessed_is_refused(tmp_path):
    key = tmp_path / "key"
    key.touch(0o600)
    key.write_text("sesame\n")
    signing = f'[zenoh.signing]\nkey_file = "{key}"\n'
    assert "found 6 characters in the first line" in refusal(tmp_path, signing)
    assert "expected at least 32" in refusal(tmp_path, signing)


@pytest.mark.parametrize("key", ["ca", "certificate", "key"])
def test_a_missing_file_is_named_with_its_key(folder, key):
    secured = '[zenoh]\nlisten = ["tls/127.0.0.1:7447"]\n'
    found = refusal(folder, secured + tls(folder, **{key: "gone.pem"}))
    assert found.startswith(f"zenoh.tls.{key}: found no file")
    assert "pyrcal certificates new" in found


@pytest.mark.parametrize("key", ["listen", "connect"])
@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1", "tcp/127.0.0.1:65536", "tcp/ao-pc:", "pigeon/127.0.0.1:7447", "7447"],
)
def test_an_endpoint_that_could_never_be_opened_is_refused(tmp_path, key, endpoint):
    """Waiting for it, as for a network that comes later, would never end."""
    path = tmp_path / "bad.toml"
    path.write_text(f'[zenoh]\n{key} = ["{endpoint}"]\n')
    with pytest.raises(ConfigurationError, match=f"zenoh.{key}: found {endpoint}, expected"):
        load_settings(path, {})


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/[::1]:7447", "tls/localhost:65535#so_sndbuf=1", "udp/127.0.0.1:0", "unixsock-stream/x"],
)
def test_endpoints_of_zenoh_are_taken(endpoint):
    assert ZenohTable(listen=(endpoint,)).listen == (endpoint,)


@pytest.mark.parametrize("name", ["rtc-key.pem", "garbage.pem"])
def test_a_key_of_another_certificate_is_refused(folder, name):
    """Only a file that is wrong ends the service: zenoh would say so when it opens the link."""
    garbage = folder / "garbage.pem"
    garbage.touch(0o600)
    garbage.write_text("none")
    secured = '[zenoh]\nlisten = ["tls/127.0.0.1:7447"]\n'
    found = refusal(folder, secured + tls(folder, key=name))
    assert found.startswith(f"zenoh.tls.key: found {folder / name}")


def test_a_private_key_that_others_can_read_is_refused(folder):
    loose = folder / "loose.pem"
    loose.write_bytes((folder / "service-key.pem").read_bytes())
    loose.chmod(0o640)
    secured = '[zenoh]\nlisten = ["tls/127.0.0.1:7447"]\n'
    assert f"chmod 600 {loose}" in refusal(folder, secured + tls(folder, key="loose.pem"))


def test_a_name_has_one_role():
    with pytest.raises(ValueError, match="found ao twice, expected one role for each name"):
        AccessTable(rtc=("ao",), viewer=("ao",))


def test_a_router_with_passwords_needs_those_of_all(tmp_path):
    own = tmp_path / "own"
    own.touch(0o600)
    users = f'[zenoh.users]\nname = "service"\npassword_file = "{own}"\n'
    assert "found 0 characters in the first line" in refusal(tmp_path, users)
    own.write_text("sesame\n")
    assert "expected a file with NAME:PASSWORD of all" in refusal(tmp_path, users)
    client = f'[zenoh]\nconnect = ["tcp/127.0.0.1:7447"]\n{users}'
    path = tmp_path / "client.toml"
    path.write_text(client)
    told = link_security(load_settings(path, {}).zenoh, "bench").zenoh
    assert told == {"transport/auth/usrpwd": {"user": "service", "password": "sesame"}}
