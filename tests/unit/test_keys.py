"""Keys on the disk, and the command line that makes them."""

import json
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from pyrcal.__main__ import main
from pyrcal.terminal import login
from service.archive import Archive
from service.cli.commands import DATA_DIR
from service.config import Settings
from service.errors import ConfigurationError, UnknownIdError
from service.program import announced, running_services
from service.web.keys import KeyFile, KeyScope, is_loopback


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch, tmp_path):
    for name in [name for name in os.environ if name.startswith("PYRCAL_")]:
        monkeypatch.delenv(name)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def notes(monkeypatch, tmp_path):
    """Give where services leave their notes, and nobody has left one."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    return tmp_path / "run" / "pyrcal"


def test_a_key_is_made_where_the_service_runs(tmp_path, notes, capsys):
    folder = tmp_path / "elsewhere"
    with announced(folder, "http://127.0.0.1:8080"):
        assert main(["key", "add", "ada", "--scope", "operate"]) == 0
    assert str(folder / "keys.json") in capsys.readouterr().err
    assert [key.name for key in KeyFile(folder).all()] == ["ada"]
    assert not list(notes.iterdir()), "it has ended"
    assert main(["key", "add", "bob", "--scope", "read"]) == 0
    assert [key.name for key in KeyFile(tmp_path / "var").all()] == ["bob"]


def test_a_note_of_a_service_that_was_killed_counts_for_nothing(tmp_path, notes):
    notes.mkdir(parents=True, mode=0o700)
    left = notes / "7.json"
    left.write_text(json.dumps({"data_dir": str(tmp_path / "gone"), "url": ""}))
    assert running_services() == ()
    assert not left.exists()


def test_of_several_services_somebody_says_which(tmp_path, notes, monkeypatch, capsys):
    with announced(tmp_path / "one", "http://127.0.0.1:1"):
        monkeypatch.setattr(os, "getpid", lambda: 2)
        with announced(tmp_path / "two", "http://127.0.0.1:2"):
            assert main(["key", "list"]) == 2
            told = capsys.readouterr().err
            assert main(["key", "list", "--data-dir", str(tmp_path / "two")]) == 0
    assert "found 2 services" in told
    assert str(tmp_path / "one") in told


def test_a_folder_others_may_write_into_is_not_believed(tmp_path, notes):
    notes.mkdir(parents=True)
    notes.chmod(0o777)
    with announced(tmp_path / "one", "http://127.0.0.1:1"):
        assert not list(notes.iterdir())
    assert running_services() == ()


def test_a_key_is_found_by_itself_and_not_to_be_had_from_the_file(tmp_path):
    file = KeyFile(tmp_path / "new")
    secrets = {scope: file.add(scope.value, scope) for scope in KeyScope}
    kept = file.path.read_text()
    for scope, secret in secrets.items():
        assert len(secret) >= 43, "256 bits"
        assert secret not in kept
        assert secret.removeprefix("pyrcal_") not in kept
        found = file.key_of(secret)
        assert (found.name, found.scope) == (scope.value, scope)
    assert len(set(secrets.values())) == 3
    for wrong in ("", "pyrcal_", secrets[KeyScope.READ][:-1], found.sha256, "\udcff"):
        assert file.key_of(wrong) is None


def test_scopes_are_ranks():
    read, operate, admin = KeyScope
    covered = [(a, b) for a in KeyScope for b in KeyScope if a.covers(b)]
    assert set(covered) == {
        (read, read),
        (operate, read),
        (operate, operate),
        (admin, read),
        (admin, operate),
        (admin, admin),
    }


def test_nobody_else_can_read_the_file_whatever_lay_there(tmp_path):
    file = KeyFile(tmp_path)
    part = tmp_path / "keys.json.part"
    part.write_text("left over")
    part.chmod(0o666)
    file.add("ada", KeyScope.READ)
    assert stat.S_IMODE(file.path.stat().st_mode) == 0o600
    file.revoke("ada")
    assert stat.S_IMODE(file.path.stat().st_mode) == 0o600


def test_another_process_s_keys_are_seen_at_once(tmp_path):
    here, there = KeyFile(tmp_path), KeyFile(tmp_path)
    assert here.all() == ()
    secret = there.add("ada", KeyScope.OPERATE)
    assert here.key_of(secret) is not None
    there.revoke("ada")
    assert here.key_of(secret) is None
    again = there.add("ada", KeyScope.OPERATE)
    assert here.key_of(secret) is None, "the name is the same, the key is not"
    assert here.key_of(again) is not None
    there.path.unlink()
    assert here.key_of(again) is None


def test_keys_made_at_the_same_time_are_all_kept(tmp_path):
    names = [f"n{k}" for k in range(20)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda name: KeyFile(tmp_path).add(name, KeyScope.READ), names))
    assert sorted(key.name for key in KeyFile(tmp_path).all()) == sorted(names)


@pytest.mark.parametrize("name", ["", "a b", "-a", "é", "a" * 65, "a\n", "service", "operator"])
def test_a_name_that_the_audit_trail_could_not_bear_is_refused(tmp_path, name):
    with pytest.raises(ConfigurationError, match="expected up to 64 letters"):
        KeyFile(tmp_path).add(name, KeyScope.READ)


def test_a_name_is_one_key_and_an_unknown_one_is_said(tmp_path):
    file = KeyFile(tmp_path)
    file.add("ada", KeyScope.READ)
    with pytest.raises(ConfigurationError, match="found a key ada already"):
        file.add("ada", KeyScope.ADMIN)
    with pytest.raises(UnknownIdError, match="there are ada"):
        file.revoke("bob")


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"{}", b'[{"name": "ada"}]', b'[{"name":"a","scope":"root","created_ns_utc":0}]'],
)
def test_a_damaged_file_is_no_open_door(tmp_path, content):
    file = KeyFile(tmp_path)
    secret = file.add("ada", KeyScope.READ)
    file.path.write_bytes(content)
    for attempt in (file.all, lambda: file.key_of(secret), lambda: file.revoke("ada")):
        with pytest.raises(ConfigurationError, match=r"keys\.json: cannot be read"):
            attempt()


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.0.0.2", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("10.0.0.5", False),
        ("ao-pc", False),
        ("localhost.evil.example", False),
    ],
)
def test_what_loopback_is(host, expected):
    assert is_loopback(host) is expected


# --- the command line


def test_keys_are_made_listed_and_revoked(capsys, tmp_path):
    assert main(["key", "add", "ada", "--scope", "operate"]) == 0
    shown = capsys.readouterr()
    secret = shown.out.strip()
    assert secret.startswith("pyrcal_")
    assert "shown only now" in shown.err
    assert KeyFile(tmp_path / "var").key_of(secret).name == "ada"
    assert main(["key", "list"]) == 0
    listed = capsys.readouterr().out
    assert "ada" in listed
    assert "operate" in listed
    assert secret not in listed
    assert main(["key", "revoke", "ada"]) == 0
    assert main(["key", "list"]) == 0
    told = capsys.readouterr()
    assert (told.out, "so nobody may ask" in told.err) == ("", True)
    assert main(["key", "revoke", "ada"]) == 2
    assert "no such key" in capsys.readouterr().err


def test_the_audit_trail_of_a_service_that_runs_has_who_made_and_revoked_a_key(tmp_path):
    with Archive(tmp_path / "var") as archive:
        archive.open()
        assert main(["key", "add", "ada", "--scope", "operate"]) == 0
        assert main(["key", "revoke", "ada"]) == 0
        made, revoked = archive.audit_trail()
    assert (made.name, made.text, made.channel) == ("key.added", "ada may operate", "cli")
    assert (revoked.name, revoked.text) == ("key.revoked", "ada")
    assert made.who == login()


def test_keys_are_where_the_service_looks_for_them(monkeypatch, tmp_path, capsys):
    assert Settings().service.data_dir.as_posix() == DATA_DIR
    config = tmp_path / "pyrcal.toml"
    config.write_text('[service]\ndata_dir = "of-the-file"\n')
    add = ["key", "add", "ada", "--scope", "read"]
    main([*add, "--config", str(config)])
    monkeypatch.setenv("PYRCAL_SERVICE__DATA_DIR", "of-the-environment")
    main([*add, "--config", str(config)])
    main([*add, "--data-dir", "given"])
    assert {path.parent.name for path in tmp_path.glob("*/keys.json")} == {
        "of-the-file",
        "of-the-environment",
        "given",
    }
    monkeypatch.delenv("PYRCAL_SERVICE__DATA_DIR")
    config.write_text("[service")
    assert main([*add, "--config", str(config)]) == 2
    assert "pyrcal.toml: cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.5", "ao-pc"])
def test_the_service_is_not_open_to_others_before_somebody_can_give_orders(capsys, tmp_path, host):
    run = ["run", "--host", host, "--data-dir", str(tmp_path)]
    assert main(run) == 2
    told = capsys.readouterr().err
    assert f"found {host}" in told
    assert "pyrcal key add NAME --scope operate" in told
    KeyFile(tmp_path).add("watcher", KeyScope.READ)
    assert main(run) == 2, "nobody could stop it"
    assert "no key of scope operate" in capsys.readouterr().err


def test_the_service_does_not_start_beside_keys_that_it_cannot_read(capsys, tmp_path):
    (tmp_path / "keys.json").write_text("nonsense")
    assert main(["run", "--data-dir", str(tmp_path)]) == 2
    assert "keys.json: cannot be read" in capsys.readouterr().err


def test_making_a_key_loads_nothing_that_takes_long(tmp_path):
    """What it takes is 0.2 s of processor time; a test of seconds would fail under load."""
    words = "['key', 'add', 'ada', '--scope', 'read']"
    code = f"import json, sys; from pyrcal.__main__ import main; main({words})\n"
    code += "print(json.dumps(sorted(sys.modules)))"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    loaded = set(json.loads(told.stdout.splitlines()[-1]))
    assert loaded & {"pydantic", "numpy", "h5py", "fastapi", "httpx"} == set()
