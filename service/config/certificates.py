"""Read a certificate: whose it is, and until when it holds."""

from __future__ import annotations

from pathlib import Path

from service.files.toml import refuse
from service.link.guard import Certificate


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
