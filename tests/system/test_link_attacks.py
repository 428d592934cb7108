"""Eight attacks on the link, by strangers who use zenoh and nothing of pyrcal's.

On an open link each of them succeeds: the attacks are real. On a secured one none does, whatever
the attacker has: nothing, a certificate of his own making, or the viewer's.
"""

import asyncio
import json
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import msgpack
import numpy as np
import pytest
import zenoh

from service.config.link_tables import AccessTable, TlsTable, UsersTable, ZenohTable, link_security
from service.errors import LinkError
from service.link.guard import MIN_ALARM_CONNECTIONS
from service.records.alarms import LINK_FLOODED
from service.rtc_bridge import Bridge, Endpoint
from service.runtime.readiness import complaints
from service.wire import LoopRequest, Role
from service.wire.access import NO_SECURITY, LinkSecurity
from service.wire.signing import Signatures
from tests.support.cable import free_port
from tests.support.fake_rtc import FakeRtc
from tests.support.pace import Deadline

pytestmark = pytest.mark.system

ROOT = "ao/v1/bench"
SETTLED_S = 0.4
"""What has not arrived on loopback after this long is not on its way."""


# ---------------------------------------------------------------- the attacker: zenoh alone


def attacker(endpoint, mode="client", **settings):
    """Open a session the way anybody would; a zenoh.ZError where nobody lets it in."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 1500,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    } | settings
    if mode != "client":
        settings["listen/endpoints"] = []
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def certificate(folder, name, ca=None):
    return {
        "transport/link/tls": {
            "root_ca_certificate": str((ca or folder) / "ca.pem"),
            "enable_mtls": True,
            "connect_certificate": str(folder / f"{name}.pem"),
            "connect_private_key": str(folder / f"{name}-key.pem"),
        }
    }


def asked(session, selector, payload=None):
    replies = session.get(selector, payload=payload, timeout=SETTLED_S)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]


def read_all(session, bench):
    """Hear what the RTC says, and ask for the matrix in use."""
    heard = []
    keys = ("**", "ao/**", f"{ROOT}/**", f"{ROOT}/tel/*", f"{ROOT}/tel/frames", f"{ROOT}/cm/ack")
    held = [session.declare_subscriber(key, heard.append) for key in (*keys, f"{ROOT}/im/**")]
    held += [session.liveliness().declare_subscriber("ao/**", heard.append, history=True)]
    time.sleep(SETTLED_S)
    bench.rtc.send(bench.next_seq())
    bench.rtc.acknowledge(None, None, "rejected", "read me")
    time.sleep(SETTLED_S)
    matrix = asked(session, f"{ROOT}/rtc/cm/applied") + asked(session, f"{ROOT}/cm/current")
    tokens = [reply for reply in session.liveliness().get("ao/**", timeout=0.3) if reply.ok]
    return bool(heard or matrix or tokens) and len(held) > 0


def command(session, bench):
    """Raise the gain until the loop diverges."""
    order = {"v": 1, "id": "mine", "gains": [1.9] * 4, "leak": 1.0, "loop": None}
    before = len(bench.rtc.commands)
    replies = asked(session, f"{ROOT}/cmd/rtc/loop", msgpack.packb(order | {"n_controlled": None}))
    return bool(replies) or len(bench.rtc.commands) > before


def own_matrix(session, bench):
    """Put a matrix of one's own on the mirror: the manifest of the last one, other numbers."""
    manifest, matrix = bench.manifest("mine", np.full((2, 6), 9.0, np.float32))
    session.put(f"{ROOT}/cm/mine/chunk/0", matrix)
    session.put(f"{ROOT}/cm/mine/commit", manifest)
    time.sleep(SETTLED_S)
    return bench.rtc.cm_id == "mine"


def forged_acknowledgement(session, bench):
    said = {"v": 1, "session": "s1", "id": None, "sha256": None, "state": "rejected"}
    before = bench.bridge.statistics().acknowledgements_received
    session.put(f"{ROOT}/cm/ack", msgpack.packb(said | {"reason": "range: x", "frame_seq": None}))
    time.sleep(SETTLED_S)
    return bench.bridge.statistics().acknowledgements_received > before


def forged_frames(session, bench):
    before = bench.bridge.statistics().batches_received
    session.put(f"{ROOT}/tel/frames", b"\0" * 400, attachment=msgpack.packb({"v": 1}))
    time.sleep(SETTLED_S)
    after = bench.bridge.statistics()
    return after.batches_received > before or "frames" in after.messages_malformed


def forged_status(session, bench):
    before = sum(bench.bridge.statistics().messages_malformed.values())
    session.put(f"{ROOT}/tel/status", msgpack.packb({"v": 1, "session": "s1"}))
    time.sleep(SETTLED_S)
    return sum(bench.bridge.statistics().messages_malformed.values()) > before


def service_token(session, bench):
    """Be the service that was there first, so that the true one stands by; or the RTC."""
    tokens = [f"{ROOT}/alive/service/1-1", f"{ROOT}/alive/service", f"{ROOT}/alive/rtc2"]
    held = [session.liveliness().declare_token(key) for key in tokens]
    time.sleep(SETTLED_S)
    found = {
        str(reply.ok.key_expr)
        for reply in bench.rtc.zenoh.liveliness().get(f"{ROOT}/alive/service", timeout=0.5)
        if reply.ok
    }
    stands_by = not bench.drives()
    for token in held:
        token.undeclare()
    return stands_by or not found


def queryable(session, bench):
    """Answer in the RTC's place what the service commands, and in the service's what it offers."""
    taken = []

    def answer(query):
        with query:
            taken.append(str(query.key_expr))

    keys = (f"{ROOT}/cmd/rtc/*", f"{ROOT}/rtc/cm/applied", f"{ROOT}/cm/*", f"{ROOT}/cm/current")
    held = [session.declare_queryable(key, answer, complete=True) for key in keys]
    time.sleep(SETTLED_S)
    bench.drives()
    bench.rtc.fetch(f"{ROOT}/cm/current")
    time.sleep(SETTLED_S)
    for each in held:
        each.undeclare()
    return bool(taken)


ATTACKS = (
    read_all,
    command,
    own_matrix,
    forged_acknowledgement,
    forged_frames,
    forged_status,
    service_token,
    queryable,
)


# ---------------------------------------------------------------- the bench: service and RTC


class Bench:
    def __init__(self, bridge, rtc):
        self.bridge, self.rtc, self.seq, self.n_asked = bridge, rtc, 0, 0

    def next_seq(self):
        self.seq += 10
        return self.seq

    def drives(self):
        """Whether the service still commands the RTC."""
        self.n_asked += 1
        order = LoopRequest(id=f"asked-{self.n_asked}", leak=0.98)
        self.bridge.events()
        try:
            return asyncio.run(self.bridge.command(order)).accepted
        except LinkError:
            return False

    def manifest(self, name, matrix):
        from service.wire import Manifest, encode, layout_of

        layout = layout_of(matrix, 1024)
        made = Manifest(
            id=name,
            layout=layout,
            basis_id="kl-1",
            config_id="mask-1",
            created_ns=1,
            system="bench",
            alpha=None,
            sigma=None,
            im_id=None,
            parent=None,
        )
        return encode(made), matrix.tobytes()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certificates")
    for each in ("ours", "foreign"):
        make = [sys.executable, "-m", "pyrcal", "certificates", "new", str(folder / each)]
        subprocess.run(make, check=True, capture_output=True)
    return folder


def tables(folder, port):
    tls = {name: folder / "ours" / file for name, file in FILES.items()}
    return ZenohTable(listen=(f"tls/127.0.0.1:{port}",), tls=TlsTable(**tls))


FILES = {"ca": "ca.pem", "certificate": "service.pem", "key": "service-key.pem"}


@contextmanager
def bench(listen, security, **of_rtc):
    endpoint = Endpoint(system="bench", listen=listen, security=security, command_attempts=1)
    with Bridge(endpoint) as bridge, FakeRtc(listen[0], **of_rtc) as rtc:
        deadline = Deadline(15.0)
        while not bridge.statistics().rtc_alive:
            assert not deadline.passed, "the RTC was not let in"
            time.sleep(0.01)
        scene = Bench(bridge, rtc)
        scene.listen = listen[0]
        rtc.send_status()  # whose start orders are signed for
        while bridge.statistics().statuses_received < 1:
            assert not deadline.passed, "the RTC is not heard"
            time.sleep(0.01)
        assert scene.drives()
        rtc.send(0)
        yield scene


@pytest.fixture
def secured(folder):
    zenoh_table = tables(folder, free_port())
    security = link_security(zenoh_table, "bench")
    with bench(zenoh_table.listen, security, **certificate(folder / "ours", "rtc")) as scene:
        yield scene


@pytest.fixture
def generous(folder):
    """A router that tells the viewer everything that it would tell an RTC: politeness is off.

    zenoh does not send what nobody is said to subscribe to, so that on a link as it should be most
    of an attack does not even leave the attacker. Here it does, and must be refused on arrival.
    """
    zenoh_table = tables(folder, free_port())
    security = link_security(zenoh_table, "bench")
    control = security.zenoh["access_control"]
    told = ["declare_subscriber", "declare_queryable", "reply", "query", "liveliness_query"]
    rule = {"id": "told", "permission": "allow", "flows": ["egress"], "key_exprs": ["**"]}
    control["rules"].append(rule | {"messages": [*told, "declare_liveliness_subscriber"]})
    control["policies"].append({"rules": ["told"], "subjects": ["viewer"]})
    with bench(zenoh_table.listen, security, **certificate(folder / "ours", "rtc")) as scene:
        yield scene


# ---------------------------------------------------------------- what becomes of them


def test_on_an_open_link_every_attack_succeeds():
    listen = (f"tcp/127.0.0.1:{free_port()}",)
    with bench(listen, NO_SECURITY) as scene, attacker(listen[0]) as session:
        assert [attack.__name__ for attack in ATTACKS if not attack(session, scene)] == []


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_with_the_viewers_certificate_no_attack_succeeds(secured, folder, mode):
    with attacker(secured.listen, mode, **certificate(folder / "ours", "viewer")) as session:
        assert [attack.__name__ for attack in ATTACKS if attack(session, secured)] == []


def test_what_does_leave_an_attacker_is_refused_on_arrival(generous, folder):
    with attacker(generous.listen, **certificate(folder / "ours", "viewer")) as session:
        assert [attack.__name__ for attack in ATTACKS if attack(session, generous)] == []


def test_a_certificate_of_no_role_lets_in_and_to_nothing(folder):
    zenoh_table = tables(folder, free_port())
    roles = AccessTable(viewer=())
    security = link_security(zenoh_table.model_copy(update={"access": roles}), "bench")
    with (
        bench(zenoh_table.listen, security, **certificate(folder / "ours", "rtc")) as scene,
        attacker(zenoh_table.listen[0], **certificate(folder / "ours", "viewer")) as session,
    ):
        assert [attack.__name__ for attack in ATTACKS if attack(session, scene)] == []


@pytest.mark.parametrize("who", ["nothing", "his own rtc", "the authority alone", "plain tcp"])
def test_a_stranger_cannot_connect(secured, folder, who):
    endpoint, how = secured.listen, {}
    if who == "his own rtc":
        how = certificate(folder / "foreign", "rtc", ca=folder / "ours")
    elif who == "the authority alone":
        how = {"transport/link/tls": {"root_ca_certificate": str(folder / "ours" / "ca.pem")}}
    elif who == "plain tcp":
        endpoint = endpoint.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        attacker(endpoint, **how).close()
    assert secured.drives()


def test_a_flood_of_one_port_is_named_and_an_rtc_is_let_in_at_another(folder):
    """Sixty connections closed before a handshake keep the first port busy for six seconds."""
    flooded, free = free_port(), free_port()
    both = (f"tls/127.0.0.1:{flooded}", f"tls/127.0.0.1:{free}")
    zenoh_table = tables(folder, flooded).model_copy(update={"listen": both})
    endpoint = Endpoint(
        system="bench",
        listen=both,
        security=link_security(zenoh_table, "bench"),
        command_attempts=1,
    )
    with Bridge(endpoint) as bridge:
        for _ in range(60):
            socket.create_connection(("127.0.0.1", flooded)).close()
        assert complaints(bridge.statistics()).keys() == {LINK_FLOODED}
        with FakeRtc(both[1], **certificate(folder / "ours", "rtc")):
            deadline = Deadline(3.0)
            while not bridge.statistics().rtc_alive:
                assert not deadline.passed, "the RTC was not let in"
                time.sleep(0.01)
        assert bridge.statistics().waiting_connections[flooded] >= MIN_ALARM_CONNECTIONS


def test_an_rtc_is_let_by_nobody_who_only_says_that_he_is_the_service(folder):
    """A router in the service's place: an RTC sends nothing to one without its certificate."""
    port = free_port()
    listens = certificate(folder / "foreign", "service")["transport/link/tls"]
    false = {
        "root_ca_certificate": listens["root_ca_certificate"],
        "listen_certificate": listens["connect_certificate"],
        "listen_private_key": listens["connect_private_key"],
    }
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tls/127.0.0.1:{port}"]))
    config.insert_json5("transport/link/tls", json.dumps(false))
    with zenoh.open(config), pytest.raises(zenoh.ZError):
        attacker(f"tls/127.0.0.1:{port}", **certificate(folder / "ours", "rtc")).close()


def test_a_viewer_sees_the_state_late_and_live_and_the_statuses(secured, folder):
    from service.wire import StateMessage

    state = StateMessage(system="bench", t_ns=1, mode="auto", alpha=None, sigma=None, in_use="r-1")
    secured.bridge.publish_state(state)
    seen = []
    with attacker(secured.listen, **certificate(folder / "ours", "viewer")) as session:
        history = zenoh.ext.HistoryConfig(max_samples=1)
        late = zenoh.ext.declare_advanced_subscriber(session, f"{ROOT}/state", history=history)
        held = session.declare_subscriber(f"{ROOT}/tel/status", seen.append)
        time.sleep(SETTLED_S)
        secured.rtc.send_status()
        deadline = Deadline(10.0)
        while not (seen and (first := late.try_recv())):
            assert not deadline.passed, "a viewer sees nothing"
            time.sleep(0.05)
        assert msgpack.unpackb(first.payload.to_bytes())["in_use"] == "r-1"
        held.undeclare()


def test_with_passwords_on_loopback_no_attack_succeeds_either(tmp_path):
    listen = (f"tcp/127.0.0.1:{free_port()}",)
    for name, text in {"own": "sesame", "users": "rtc:a\nviewer:b\nservice:sesame\n"}.items():
        path = tmp_path / name
        path.touch(0o600)
        path.write_text(text)
    users = UsersTable(name="service", password_file=tmp_path / "own", file=tmp_path / "users")
    security = link_security(ZenohTable(listen=listen, users=users), "bench")

    def user(name, password):
        return {"transport/auth/usrpwd": {"user": name, "password": password}}

    with bench(listen, security, **user("rtc", "a")) as scene:
        with attacker(listen[0], **user("viewer", "b")) as session:
            assert [attack.__name__ for attack in ATTACKS if attack(session, scene)] == []
        for how in (user("viewer", "wrong"), user("nobody", "a"), {}):
            with pytest.raises(zenoh.ZError):
                attacker(listen[0], **how).close()


# ---------------------------------------------------------------- a router that somebody else runs

SECRET = b"what RTC and service alone know."
FORGERIES = (command, own_matrix, forged_acknowledgement)
"""Who runs the router reads all and may send anything: what remains is that nobody believes it."""


@pytest.fixture
def signed():
    """A link on which anybody may say anything, and what RTC and service say is signed."""
    listen = (f"tcp/127.0.0.1:{free_port()}",)
    with bench(listen, LinkSecurity(secret=SECRET), secret=SECRET) as scene:
        yield scene


def test_what_nobody_has_signed_is_not_believed(signed):
    with attacker(signed.listen) as session:
        before = signed.bridge.statistics()
        assert [forge.__name__ for forge in FORGERIES if forge(session, signed)] == ["command"]
        assert [order.id for order in signed.rtc.commands if order.id == "mine"] == []
        forged_frames(session, signed)
        forged_status(session, signed)
        after = signed.bridge.statistics()
    assert after.batches_received == before.batches_received
    assert after.statuses_received == before.statuses_received
    assert set(after.messages_malformed) == {"ack", "frames", "status"}
    texts = {each.text for each in after.dispositions if each.outcome == "malformed"}
    assert len(texts) == 1
    assert texts.pop().startswith("signature: none")


def test_what_was_said_before_is_not_believed_again(signed):
    """The stranger keeps all that is said, and says it once more."""
    kept = []

    def keep(sample):
        attachment = sample.attachment
        kept.append((str(sample.key_expr), sample.payload.to_bytes(), attachment))

    with attacker(signed.listen) as session:
        held = session.declare_subscriber(f"{ROOT}/**", keep)
        time.sleep(SETTLED_S)
        signed.rtc.send(signed.next_seq())
        signed.rtc.send_status()
        signed.rtc.acknowledge(None, None, "rejected", "range: x")
        time.sleep(SETTLED_S)
        held.undeclare()
        before = signed.bridge.statistics()
        said = {key.removeprefix(f"{ROOT}/"): rest for key, *rest in kept}
        assert {"tel/frames", "tel/status", "cm/ack"} <= set(said)
        for key in ("tel/frames", "tel/status", "cm/ack"):
            payload, attachment = said[key]
            session.put(f"{ROOT}/{key}", payload, attachment=attachment)
        time.sleep(SETTLED_S)
        after = signed.bridge.statistics()
    assert after.batches_received == before.batches_received
    assert after.statuses_received == before.statuses_received
    assert after.acknowledgements_received == before.acknowledgements_received
    texts = {each.text for each in after.dispositions if each.outcome == "malformed"}
    assert len(texts) >= 1
    assert all(text.endswith("came before, or too late") for text in texts)


def test_an_order_of_before_counts_no_more(signed):
    """The stranger stands between: hears an order as the RTC does, and gives it again."""
    heard = []

    def between(query):
        with query:
            heard.append(query.payload.to_bytes())

    key = f"{ROOT}/cmd/rtc/loop"
    with attacker(signed.listen) as session:
        held = session.declare_queryable(key, between, complete=True)
        time.sleep(SETTLED_S)
        for _ in range(3):
            signed.drives()
        held.undeclare()
        time.sleep(SETTLED_S)
        n_before = len(signed.rtc.commands)
        assert heard
        answers = [msgpack.unpackb(data) for order in heard for data in asked(session, key, order)]
        # what the RTC did not get the first time it may carry out once, and nothing twice
        again = [msgpack.unpackb(data) for order in heard for data in asked(session, key, order)]
    assert answers
    assert not any(answer["accepted"] for answer in again)
    assert all(answer["reason"].startswith("signature: ") for answer in again)
    assert len(signed.rtc.commands) <= n_before + len(heard)


def test_an_rtc_that_signs_and_a_service_that_does_not_ask_understand_each_other():
    listen = (f"tcp/127.0.0.1:{free_port()}",)
    with bench(listen, NO_SECURITY) as scene:
        scene.rtc.signatures = Signatures(SECRET, Role.RTC)
        before = scene.bridge.statistics().statuses_received
        scene.rtc.send_status()
        time.sleep(SETTLED_S)
        assert scene.bridge.statistics().statuses_received == before + 1


def test_an_rtc_that_does_not_sign_is_named_where_signatures_are_asked_for():
    listen = (f"tcp/127.0.0.1:{free_port()}",)
    endpoint = Endpoint(system="bench", listen=listen, security=LinkSecurity(secret=SECRET))
    with Bridge(endpoint) as bridge, FakeRtc(listen[0]) as rtc:
        deadline = Deadline(15.0)
        while not bridge.statistics().messages_malformed.get("status"):
            assert not deadline.passed
            rtc.send_status()
            time.sleep(0.1)
        assert "signature: none" in str(complaints(bridge.statistics())["messages-refused"])
        order = LoopRequest(id="a", leak=0.98)
        with pytest.raises(LinkError, match="signature: none"):
            asyncio.run(bridge.command(order))
