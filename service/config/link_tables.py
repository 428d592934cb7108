"""``[zenoh]`` of the settings, and the zenoh configuration made of it."""

from __future__ import annotations

import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field, field_validator, model_validator

from service.files.toml import Table, in_file, read_toml, refuse, validated
from service.wire.access import (
    DAY_S,
    Certificate,
    LinkRole,
    LinkSecurity,
    access_control,
    is_loopback,
)
from service.wire.keys import Keys

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

MAX_PORT: Final = 65_535

USERS: Final = "transport/auth/usrpwd"
"""Key of zenoh's configuration."""

SHORTEST_SECRET: Final = 32
"""Characters."""

_ENCRYPTED: Final = re.compile("(tls|quic)/")

_USABLE: Final = re.compile("(tcp|tls|udp|quic|ws)/[^?#]*:([0-9]{1,5})([?#].*)?|unixsock-stream/.+")
"""Endpoint of a protocol that zenoh's Python package has. Anything else could never be opened, and
the service would wait for it for ever."""

Names = tuple[Annotated[str, Field(min_length=1, max_length=64)], ...]


class TlsTable(Table):
    """``[zenoh.tls]``: certificates that every program must have to connect."""

    ca: Path
    """Certificate of the authority, PEM."""

    certificate: Path
    """Certificate of the service, PEM."""

    key: Path
    """Private key, PEM; no other user may read the file."""

    watched: tuple[Path, ...] = ()
    """Certificates of other programs, such as the RTC, to warn of, too."""

    warn_days: float = Field(default=30.0, ge=0.0, le=1000.0)
    """Days before the end of a certificate at which an alarm begins."""


class UsersTable(Table):
    """``[zenoh.users]``: names and passwords; on loopback they may replace certificates."""

    name: str = Field(min_length=1, pattern="^[^:]+$")
    """Name of the service."""

    password_file: Path
    """File whose first line is its password; no other user may read it."""

    file: Path | None = None
    """File of lines ``NAME:PASSWORD`` of all that may connect, for the embedded router."""


class AccessTable(Table):
    """``[zenoh.access]``: names of the programs that may act as RTC, service or viewer.

    A name is the common name of a certificate; without ``[zenoh.tls]`` that of a user.
    """

    rtc: Names = ("rtc",)
    """Send telemetry and acknowledgements, answer commands."""

    service: Names = ("service",)
    """Command and send matrices, as other services and ``pyrcal check-rtc`` do."""

    viewer: Names = ("viewer",)
    """Read state, alarms, statuses and published matrices only."""

    @model_validator(mode="after")
    def _one_role_for_each_name(self) -> AccessTable:
        names = [*self.rtc, *self.service, *self.viewer]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"found {', '.join(twice)} twice, expected one role for each name")
        return self


class SigningTable(Table):
    """``[zenoh.signing]``: signatures of service and RTC, if the router is not trusted."""

    key_file: Path
    """File whose first line is the shared secret; no other user may read it."""


class CredentialsTable(Table):
    """``[zenoh]`` of a program that only connects: who it is, and whom it trusts."""

    tls: TlsTable | None = None
    """Certificates; None: anybody who reaches the port can put a matrix on the mirror."""

    users: UsersTable | None = None
    """Names and passwords; None: not required."""

    signing: SigningTable | None = None
    """Shared secret; None: messages are not signed."""


class ZenohTable(CredentialsTable):
    """``[zenoh]``: link to the RTC."""

    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    """Endpoints on which the embedded router listens."""

    connect: tuple[str, ...] = ()
    """Endpoints of an observatory's routers, instead of the embedded one."""

    chunk_bytes: int = Field(default=4_000_000, ge=1024, le=4_000_000)
    """Size of a reconstructor's chunks; zenoh-pico drops more than 4 KB by default."""

    access: AccessTable = Field(default_factory=AccessTable)
    """Roles of the names in certificates or users."""

    anyone_may_command_the_mirror: bool = False
    """Accept addresses other than loopback without ``[zenoh.tls]``: anybody who reaches them can
    put a matrix on the mirror."""

    @field_validator("listen", "connect")
    @classmethod
    def _that_can_be_opened(cls, endpoints: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in endpoints:
            parts = _USABLE.fullmatch(endpoint)
            if parts is None or int(parts[2] or 0) > MAX_PORT:
                expected = f"tcp, tls, udp, quic or ws/HOST:PORT like {DEFAULT_ENDPOINT}"
                raise ValueError(f"found {endpoint}, expected {expected}, PORT up to {MAX_PORT}")
        return endpoints

    @model_validator(mode="after")
    def _with_certificates_no_way_around_them(self) -> ZenohTable:
        # With ``connect`` there is no router of its own, and ``listen`` is not used.
        open_ones = [each for each in self.connect or self.listen if not _ENCRYPTED.match(each)]
        if self.tls is not None and open_ones:
            raise ValueError(
                f"found {', '.join(open_ones)} together with [zenoh.tls], expected tls/HOST:PORT: "
                "all connections need a certificate"
            )
        return self

    @model_validator(mode="after")
    def _nobody_from_elsewhere_without_a_certificate(self) -> ZenohTable:
        # With ``connect`` the service opens no port; the observatory's routers control access.
        if self.tls is not None or self.connect or self.anyone_may_command_the_mirror:
            return self
        for endpoint in self.listen:
            host = _host_of(endpoint)
            if host is not None and not is_loopback(host):
                raise ValueError(
                    f"found listen {endpoint}, which other machines can reach, without "
                    "[zenoh.tls]: any program that reaches it can send matrices to the mirror; "
                    "pyrcal certificates new FOLDER --host NAME makes certificates, and settings "
                    f"that use them (docs/operate/link.md), or listen on {DEFAULT_ENDPOINT}"
                )
        return self


def _host_of(endpoint: str) -> str | None:
    """Return the host of an endpoint; None: it is a socket of this machine's files."""
    protocol, _, address = endpoint.partition("/")
    if protocol.startswith("unix"):
        return None
    # Metadata and options of zenoh's endpoints follow ? and #; brackets are those of IPv6.
    # The last colon precedes the port; an IPv6 address contains others.
    return re.split(r"[?#]", address)[0].rpartition(":")[0].strip("[]")


class _OfAnyProgram(Table):
    """The one table of a settings file that every program on the link reads."""

    zenoh: ZenohTable = Field(default_factory=ZenohTable)


def read_link_tables(
    path: Path | None, *, listen: str | None = None, connect: str | None = None
) -> ZenohTable:
    """Return ``[zenoh]`` of a settings file, whatever else is in it; what else is given replaces.

    Raises
    ------
    ConfigurationError
        One line: where, what was found, what was expected.
    """
    table = {} if path is None else read_toml(path).get("zenoh", {})
    # Anything else is left to the validation, which says what it is.
    if isinstance(table, dict):
        given = {"listen": listen, "connect": connect}
        table |= {key: [value] for key, value in given.items() if value is not None}
    place = in_file(path) if path is not None else ".".join
    return validated(_OfAnyProgram, {"zenoh": table}, place).zenoh


@dataclass(frozen=True, slots=True, kw_only=True)
class Router:
    """The router that a program connects to, and what it shows there."""

    endpoint: str
    security: Mapping[str, object] = field(default_factory=dict)
    """Certificates and users for zenoh's configuration; empty if there are none."""

    secret: bytes | None = None
    """Secret that messages are signed with; None if they are not."""


def router_of(path: Path | None, connect: str | None) -> Router:
    """Return the router that a settings file names, or ``connect`` instead.

    Raises
    ------
    ConfigurationError
        One line: where, what was found, what was expected.
    """
    zenoh = read_link_tables(path, connect=connect)
    endpoint = (*zenoh.connect, DEFAULT_ENDPOINT)[0]
    return Router(endpoint=endpoint, security=client_security(zenoh), secret=secret_of(zenoh))


def link_security(zenoh: ZenohTable, system: str) -> LinkSecurity:
    """Return how the service's link is secured.

    An embedded router controls access itself; where an observatory's own routers are used, theirs
    do, and the service only shows who it is.

    Raises
    ------
    ConfigurationError
        If a file is missing, or others can read what is secret.
    """
    settings: dict[str, object] = {**client_security(zenoh)}
    secret = secret_of(zenoh)
    if not settings:
        return LinkSecurity(secret=secret)
    access = zenoh.access
    names = {
        LinkRole.RTC: access.rtc,
        LinkRole.SERVICE: access.service,
        LinkRole.VIEWER: access.viewer,
    }
    # Only a router needs the passwords of all users; a client sends its own.
    if zenoh.users is not None and not zenoh.connect:
        known = {"dictionary_file": _users_file(zenoh.users)}
        settings[USERS] = {**_own_user(zenoh.users), **known}
    if not zenoh.connect:
        subject_kind = "usernames" if zenoh.tls is None else "cert_common_names"
        settings["access_control"] = access_control(Keys(system), names, subject_kind=subject_kind)
    return LinkSecurity(
        zenoh=settings,
        roles={name: str(role) for role, every in names.items() for name in every},
        certificates=() if zenoh.tls is None else _certificates_of(zenoh.tls),
        secret=secret,
        warn_s=DAY_S * (0.0 if zenoh.tls is None else zenoh.tls.warn_days),
    )


def _certificates_of(tls: TlsTable) -> tuple[Certificate, ...]:
    watched = [(path, "zenoh.tls.watched") for path in tls.watched]
    own = [(tls.certificate, "zenoh.tls.certificate"), (tls.ca, "zenoh.tls.ca")]
    return tuple(read_certificate(path, key) for path, key in (*own, *watched))


def client_security(credentials: CredentialsTable) -> dict[str, dict[str, object]]:
    """Return zenoh's configuration for a client's credentials; empty without credentials.

    Raises
    ------
    ConfigurationError
        If a file is missing, or others can read what is secret.
    """
    security: dict[str, dict[str, object]] = {}
    if credentials.tls is not None:
        security["transport/link/tls"] = _certificates(credentials.tls)
    if credentials.users is not None:
        security[USERS] = _own_user(credentials.users)
    return security


def secret_of(credentials: CredentialsTable) -> bytes | None:
    """Return the secret that messages are signed with; None: they are not.

    Raises
    ------
    ConfigurationError
        If the file is missing, others can read it, or the secret is short enough to be guessed.
    """
    if credentials.signing is None:
        return None
    line = _first_line(credentials.signing.key_file, "zenoh.signing.key_file", SHORTEST_SECRET)
    return line.encode()


def _certificates(tls: TlsTable) -> dict[str, object]:
    ca = _there(tls.ca, "zenoh.tls.ca")
    own, key = _there(tls.certificate, "zenoh.tls.certificate"), _secret(tls.key, "zenoh.tls.key")
    try:
        # zenoh would say so only when it opens the link, like a network that is not there yet.
        ssl.create_default_context().load_cert_chain(own, key, password="")
    except (OSError, ValueError) as error:
        refuse("zenoh.tls.key", f"{tls.key}: {error!s:.80}", f"the key of {own}, PEM")
    return {
        "root_ca_certificate": ca,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "listen_certificate": own,
        "listen_private_key": key,
        "connect_certificate": own,
        "connect_private_key": key,
    }


def _own_user(users: UsersTable) -> dict[str, object]:
    password = _first_line(users.password_file, "zenoh.users.password_file", 1)
    return {"user": users.name, "password": password}


def _users_file(users: UsersTable) -> str:
    if users.file is None:
        refuse("zenoh.users.file", "none", "a file with NAME:PASSWORD of all who may connect")
    return _secret(users.file, "zenoh.users.file")


def _first_line(path: Path, key: str, shortest: int) -> str:
    lines = Path(_secret(path, key)).read_text(encoding="utf-8").splitlines()
    line = lines[0].strip() if lines else ""
    if len(line) < shortest:
        found = f"{len(line)} characters in the first line of {path}"
        refuse(key, found, f"at least {shortest}")
    return line


def _there(path: Path, key: str) -> str:
    if not path.is_file():
        refuse(key, f"no file {path}", "one; pyrcal certificates new FOLDER makes all of them")
    return str(path.absolute())


def _secret(path: Path, key: str) -> str:
    found = _there(path, key)
    # Any permission of group or others.
    if path.stat().st_mode & 0o077:
        refuse(key, f"{path}, which others can read", f"it to be yours alone: chmod 600 {path}")
    return found


def read_certificate(path: Path, key: str) -> Certificate:
    """Return the first certificate in a file; ``key`` of the settings names the file.

    Raises
    ------
    ConfigurationError
        If the file has none.
    """
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    try:
        read = x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        refuse(key, f"{path}: {error!s:.120}", "a certificate, PEM")
    names = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return Certificate(
        path=str(path),
        name=str(names[0].value) if names else "",
        ends_s=read.not_valid_after_utc.timestamp(),
    )
