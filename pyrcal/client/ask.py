"""Ask a running service what a command line asks for."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from pyrcal.client import export, orders, reading, watch
from pyrcal.client.remote import KEY, NOT_DONE, UNREACHABLE, URL, USUAL_URL, Request
from pyrcal.client.rest import RefusedError, Service, UnreachableError
from service.errors import ConfigurationError, say

_COMMANDS = {
    "export": export.run_command,
    "orders": orders.run_command,
    "reading": reading.run_command,
    "watch": watch.run_command,
}


def main(options: argparse.Namespace) -> int:
    """Ask, print, and return the exit status.

    Raises
    ------
    ConfigurationError
        If the address or the key is none.
    """
    request: Request = options.request
    service = Service(options.url or os.environ.get(URL) or USUAL_URL, _key(options.key_file))
    try:
        return _COMMANDS[request.module](service, request, options)
    except RefusedError as error:
        say(f"pyrcal {request.name}: {error}")
        return NOT_DONE
    except UnreachableError as error:
        say(f"pyrcal: {error}")
        return UNREACHABLE


def _key(file: Path | None) -> str:
    """Return the API key; empty if there is none."""
    if file is None:
        return os.environ.get(KEY, "").strip()
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"--key-file {file}: {error}") from error
