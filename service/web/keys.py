"""API keys: names, scopes, hashes.

A key is 256 random bits. What is kept of it is its SHA-256: there is no dictionary to try such keys
from, so that a slow hash would protect nothing and cost the service its time with each request.
"""

from __future__ import annotations

import hmac
import os
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import msgspec

from service.errors import ConfigurationError, UnknownIdError
from service.files.durable import lock_file, replace_file

PREFIX = "pyrcal_"
"""Prefix of every key, so that a lost one is recognised."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
_TAKEN = {"service", "operator"}
"""Names that the audit trail uses for others."""


class KeyScope(StrEnum):
    """Scopes of a key; each includes those before it."""

    READ = "read"
    """Read everything, order nothing."""

    OPERATE = "operate"
    """Give orders, and upload what is to be fitted."""

    ADMIN = "admin"
    """See who has a key, and revoke one."""

    def covers(self, other: KeyScope) -> bool:
        """Return whether it is good for what needs the other."""
        ranks = list(KeyScope)
        return ranks.index(self) >= ranks.index(other)


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """Record of a key."""

    name: str
    """Name of the person, program or place that has the key."""

    scope: KeyScope
    created_ns_utc: int
    """Time of creation, nanoseconds since the Unix epoch."""

    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    """Checksum of the whole key as text."""


class KeyFile:
    """The keys of a service, as they are on the disk at this moment.

    Several processes may change the file, one after the other; readers find it whole at any time.

    Parameters
    ----------
    directory
        The service's ``data_dir``; made by :meth:`add` where it does not exist.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / "keys.json"
        self._seen: tuple[tuple[int, ...], tuple[Key, ...]] = ((), ())

    def all(self) -> tuple[Key, ...]:
        """Return the keys there are now; the file is read again only when it has changed.

        Raises
        ------
        ConfigurationError
            If the file cannot be read, or is none of keys.
        """
        try:
            found = self.path.stat()
            # The file is replaced, not rewritten: its inode changes even within one tick of the
            # clock.
            stamp = (found.st_ino, found.st_mtime_ns, found.st_size)
            before, keys = self._seen
            if stamp != before:
                keys = msgspec.json.decode(self.path.read_bytes(), type=tuple[Key, ...])
                self._seen = (stamp, keys)
        except FileNotFoundError:
            return ()
        except (OSError, UnicodeDecodeError, msgspec.MsgspecError) as error:
            raise ConfigurationError(
                f"{self.path}: cannot be read: {error}; the user who runs the service must own it; "
                "if it is damaged, move it away and make new keys with pyrcal key add"
            ) from error
        return keys

    def key_of(self, secret: str) -> Key | None:
        """Return what is kept of a key; None: it is none, or no longer.

        It takes as long whichever it is.

        Raises
        ------
        ConfigurationError
            As :meth:`all` does.
        """
        digest, found = _digest(secret), None
        for key in self.all():
            if hmac.compare_digest(key.sha256, digest):
                found = key
        return found

    def add(self, name: str, scope: KeyScope) -> str:
        """Make a key, and return it: it is not to be had again.

        Raises
        ------
        ConfigurationError
            If the name cannot be used, or the file.
        """
        if not _NAME.fullmatch(name) or name in _TAKEN:
            raise ConfigurationError(
                f"key: found name {name!r:.80}, expected up to 64 letters, digits and ._@-, and "
                f"none of {', '.join(sorted(_TAKEN))}"
            )
        secret = PREFIX + secrets.token_urlsafe(32)
        key = Key(name=name, scope=scope, created_ns_utc=time.time_ns(), sha256=_digest(secret))
        with self._alone():
            keys = self.all()
            if any(one.name == name for one in keys):
                raise ConfigurationError(
                    f"{self.path}: found a key {name} already; revoke it first, or choose another "
                    "name"
                )
            self._write((*keys, key))
        return secret

    def revoke(self, name: str) -> None:
        """Make a key worthless, from this moment on.

        Raises
        ------
        UnknownIdError
            If there is none of this name.
        ConfigurationError
            If the file cannot be read or written.
        """
        with self._alone():
            keys = self.all()
            rest = tuple(key for key in keys if key.name != name)
            if rest == keys:
                names = ", ".join(key.name for key in keys) or "none at all"
                raise UnknownIdError(f"key {name!r:.80}: no such key; there are {names}")
            self._write(rest)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Keep others from changing the file."""
        try:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder = os.open(self.path.parent, os.O_RDONLY)
        except OSError as error:
            raise ConfigurationError(f"{self.path.parent}: cannot be used: {error}") from error
        try:
            # The folder is locked and not the file, which each change replaces.
            lock_file(folder, self.path.parent, wait=True)
            yield
        finally:
            os.close(folder)

    def _write(self, keys: tuple[Key, ...]) -> None:
        try:
            replace_file(self.path, msgspec.json.format(msgspec.json.encode(keys)) + b"\n", 0o600)
        except OSError as error:
            raise ConfigurationError(f"{self.path}: cannot be written: {error}") from error


def _digest(secret: str) -> str:
    # Headers may hold any bytes: a strange key is a wrong one, not an error.
    return sha256(secret.encode(errors="surrogateescape")).hexdigest()
