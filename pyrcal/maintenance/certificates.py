"""``pyrcal certificates``: an authority and certificates for the link of a test bench."""

from __future__ import annotations

import argparse
import json
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID as Usage
from cryptography.x509.oid import NameOID

from service.config.link_tables import read_certificate
from service.errors import ConfigurationError, say
from service.wire.access import LinkRole

AUTHORITY_DAYS: Final = 3650

CLOCKS_DIFFER: Final = timedelta(hours=1)
"""Time before its creation from which a certificate is valid, for clocks that differ."""

SECRET: Final = "signing.key"
"""File with the key by which service and RTC sign their messages."""

DONE: Final = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Signed:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def main(options: argparse.Namespace) -> int:
    """Make certificates, or show those of a folder; return the exit status.

    Raises
    ------
    ConfigurationError
        If the folder cannot be written, or holds something else.
    """
    folder: Path = options.folder
    if options.action == "new":
        _make(folder, tuple(options.host.split(",")), options.zenoh_port, options.days)
    for path in sorted(folder.glob("*.pem")):
        if not path.stem.endswith("-key"):
            found = read_certificate(path, "FOLDER")
            print(f"{found.name:24} until {datetime.fromtimestamp(found.ends_s, UTC):%Y-%m-%d}")
    return DONE


def _make(folder: Path, hosts: tuple[str, ...], port: int, days: float) -> None:
    """Write one certificate for each role, signed by the folder's authority, and their settings."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        authority = _authority(folder)
        # A key in the folder is kept, as the authority is: programs that run use both.
        if not (folder / SECRET).exists():
            _write_secret(folder / SECRET, secrets.token_hex(32).encode() + b"\n")
        for role in LinkRole:
            _write(folder, str(role), _make_certificate(authority, role, hosts, days))
            _write_settings(folder.absolute(), role, hosts[0], port)
    except OSError as error:
        raise ConfigurationError(f"{folder}: cannot be written: {error.strerror}") from error
    say(
        f"{folder}: keep ca-key.pem off the network; service.toml is for pyrcal run, rtc.toml for "
        "pyrcal sim, rtc.json5 and viewer.json5 for any other program that uses zenoh"
    )


def _authority(folder: Path) -> Signed:
    """Return the folder's own authority; create it if there is none."""
    path, key_path = folder / "ca.pem", folder / "ca-key.pem"
    if not path.exists():
        key = ec.generate_private_key(ec.SECP256R1())
        name = f"pyrcal bench {datetime.now(UTC):%Y-%m-%d %H:%M}"
        builder = _builder(name, _make_name(name), key, AUTHORITY_DAYS).add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True
        )
        _write(folder, "ca", Signed(certificate=builder.sign(key, hashes.SHA256()), key=key))
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        private = load_pem_private_key(key_path.read_bytes(), password=None)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{folder}: its authority cannot be read: {error}") from error
    if not isinstance(private, ec.EllipticCurvePrivateKey):
        raise ConfigurationError(f"{key_path}: found another kind of key, expected one of pyrcal's")
    return Signed(certificate=certificate, key=private)


def _make_certificate(
    authority: Signed, role: LinkRole, hosts: tuple[str, ...], days: float
) -> Signed:
    """Return a certificate of a role; only the service's accepts connections."""
    key = ec.generate_private_key(ec.SECP256R1())
    # Names of a host matter where clients connect to it: only at the service.
    serves = role is LinkRole.SERVICE
    # Every role presents its certificate to the router, which the service is.
    usages = [Usage.CLIENT_AUTH, *([Usage.SERVER_AUTH] if serves else [])]
    builder = (
        _builder(str(role), authority.certificate.subject, key, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    )
    if serves:
        names = [_general_name(host) for host in hosts]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return Signed(certificate=builder.sign(authority.key, hashes.SHA256()), key=key)


def _builder(
    name: str, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: float
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(_make_name(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_DIFFER)
        .not_valid_after(now + timedelta(days=days))
    )


def _make_name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write(folder: Path, stem: str, signed: Signed) -> None:
    key = signed.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    _write_secret(folder / f"{stem}-key.pem", key)
    (folder / f"{stem}.pem").write_bytes(signed.certificate.public_bytes(Encoding.PEM))


def _write_secret(path: Path, data: bytes) -> None:
    """Write a file that other users can never read, not even while it is being written."""
    # Removed first, because a mode applies to new files only.
    path.unlink(missing_ok=True)
    path.touch(mode=0o600)
    path.write_bytes(data)


def _write_settings(folder: Path, role: LinkRole, host: str, port: int) -> None:
    """Write the start settings of a role's program, and zenoh's own for other programs."""
    own, key = folder / f"{role}.pem", folder / f"{role}-key.pem"
    ca, endpoint = folder / "ca.pem", f"tls/{host}:{port}"
    others = [str(folder / f"{other}.pem") for other in LinkRole if other is not role]
    # The service warns before the certificates of the others end, too.
    watched = f"watched = {json.dumps(others)}\n" if role is LinkRole.SERVICE else ""
    # A comment, because with it neither side accepts the other's messages until both have the key.
    signing = f"\n# [zenoh.signing]\n# key_file = {json.dumps(str(folder / SECRET))}\n"
    if role is LinkRole.VIEWER:
        # A viewer must not be able to sign commands.
        signing = ""
    how = "listen" if role is LinkRole.SERVICE else "connect"
    (folder / f"{role}.toml").write_text(
        f"[zenoh]\n{how} = {json.dumps([endpoint])}\n\n[zenoh.tls]\n"
        f"ca = {json.dumps(str(ca))}\ncertificate = {json.dumps(str(own))}\n"
        f"key = {json.dumps(str(key))}\n{watched}{signing}",
        encoding="utf-8",
    )
    # The service is the router: no other program takes its place.
    if role is LinkRole.SERVICE:
        return
    tls = {"root_ca_certificate": str(ca), "enable_mtls": True, "verify_name_on_connect": True}
    tls |= {"connect_certificate": str(own), "connect_private_key": str(key)}
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    (folder / f"{role}.json5").write_text(json.dumps(config, indent=2) + "\n", encoding="utf-8")
