"""A client of the service's REST interface; quick to import.

Every answer is validated before use: it may be late, truncated, endless, or come from another
program.
"""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple
from urllib.parse import urlencode, urlsplit

from service import __version__
from service.errors import CommandError, ConfigurationError, LinkError

Document = dict[str, Any]
"""A JSON object in an answer of the REST interface."""

REQUEST_TIMEOUT_S = 5.0
"""Timeout of a request that only reads, seconds."""

ORDER_TIMEOUT_S = 30.0
"""Timeout of an order, seconds: it waits for the RTC."""

MAX_ANSWER_BYTES = 100_000_000
"""Largest document that is read; the longest history has a third of that."""

_SAYS_PYRCAL = "urn:pyrcal:problem:"

_BUSY = {502, 503, 504}
"""Status of a server that has too much to do, and of a proxy whose service does not answer."""


class UnreachableError(LinkError):
    """No answer in time, or one that does not come from this version of pyrcal."""


class RefusedError(CommandError):
    """The service refused the request, or does not have its subject."""


class Fetched(NamedTuple):
    """An answer of the service."""

    document: Document
    tag: str
    """Value of its ETag header; empty if there is none."""


class Service:
    """A running service at its REST address.

    Parameters
    ----------
    url
        ``http://HOST:PORT``, or https.
    key
        API key; empty to send none.
    timeout_s
        Timeout of a request that only reads, seconds.

    Raises
    ------
    ConfigurationError
        If the address or the key is none.
    """

    def __init__(self, url: str, key: str = "", timeout_s: float = REQUEST_TIMEOUT_S) -> None:
        try:
            parts = urlsplit(url)
            self._port = parts.port
        except ValueError:
            parts, self._port = urlsplit(""), None
        # Anything else would end in an error of the HTTP library, which does not name the option.
        usable = url.isascii() and url.isprintable() and " " not in url and not parts.query
        if not (usable and parts.scheme in {"http", "https"} and parts.hostname):
            raise ConfigurationError(
                f"--url: found {url!r}, expected an address like http://127.0.0.1:8080"
            )
        if not (key.isascii() and key.isprintable()) or " " in key:
            raise ConfigurationError("API key: found blanks or control characters, expected a word")
        self.url, self._timeout_s = url, timeout_s
        self._host, self._path = parts.hostname, parts.path.rstrip("/")
        self._secure = parts.scheme == "https"
        self._headers = {"User-Agent": f"pyrcal/{__version__}"}
        if key:
            self._headers["Authorization"] = f"Bearer {key}"

    def get(self, path: str, **query: object) -> Fetched:
        """Return the document at a path.

        Raises
        ------
        RefusedError, UnreachableError
            As :meth:`answered`; or what is answered is no document.
        """
        given = {name: value for name, value in query.items() if value is not None}
        path = f"{path}?{urlencode(given)}" if given else path
        with self.open_response("GET", path, within_s=self._timeout_s) as response:
            return self._read(response)

    def order(self, method: str, path: str, body: Document, headers: Mapping[str, str]) -> Fetched:
        """Send an order and return the answer.

        One whose answer is lost is sent again where its ``Idempotency-Key`` lets it be carried out
        only once.

        Raises
        ------
        RefusedError, UnreachableError
            As :meth:`get`. It may have been carried out where the text says so.
        """
        sent = {"Content-Type": "application/json", **headers}
        raw, again = json.dumps(body).encode(), "Idempotency-Key" in headers
        while True:
            try:
                with self.open_response(
                    method, path, raw, sent, within_s=ORDER_TIMEOUT_S
                ) as response:
                    return self._read(response)
            except _LostError as error:
                if not again:
                    raise UnreachableError(
                        f"{error}; the order was sent and may have been carried out: "
                        "see pyrcal status and pyrcal audit"
                    ) from error
                # Once only: a second loss is reported to the caller.
                again = False

    @contextmanager
    def open_response(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
        *,
        within_s: float | None = None,
        silent_s: float | None = None,
    ) -> Iterator[http.client.HTTPResponse]:
        """Send a request and yield the answer, to be read.

        Parameters
        ----------
        method, path, body, headers
            The request.
        within_s
            Until the whole answer has been read, seconds; None: no limit but ``silent_s``.
        silent_s
            Without any byte, seconds; None: as long as a document may take.

        Raises
        ------
        RefusedError
            If pyrcal refuses.
        UnreachableError
            If nothing answers in time, or something else.
        """
        limit_s = within_s or silent_s or REQUEST_TIMEOUT_S
        kind = http.client.HTTPSConnection if self._secure else http.client.HTTPConnection
        connection = kind(self._host, self._port, timeout=limit_s)
        late = threading.Event()
        try:
            # Separately, because a request that was never sent is certain not to have been carried
            # out.
            connection.connect()
        except OSError as error:
            raise UnreachableError(
                f"{self.url}: nothing answers ({error}); start the service with pyrcal run, or "
                "name its address with --url or PYRCAL_URL"
            ) from error
        # Only responses with a limit for the whole: a stream of events has no end.
        # A timeout of the socket is for each read: an answer that trickles would never meet it.
        timer = threading.Timer(limit_s, _cut, (connection.sock, late))
        timer.daemon = True
        if within_s is not None:
            timer.start()
        try:
            connection.request(
                method, self._path + path, body, {**self._headers, **(headers or {})}
            )
            response = connection.getresponse()
            if response.status >= http.client.BAD_REQUEST:
                raise self._refusal(response)
            yield response
        except (OSError, http.client.HTTPException, UnreachableError) as error:
            if late.is_set() or isinstance(error, TimeoutError):
                raise _LostError(
                    f"{self.url}: no answer within {limit_s:g} s; is it stopped?"
                ) from error
            if isinstance(error, UnreachableError):
                raise
            raise _LostError(f"{self.url}: the connection was lost ({error})") from error
        finally:
            timer.cancel()
            connection.close()

    def _read(self, response: http.client.HTTPResponse) -> Fetched:
        """Return the JSON object in an answer."""
        # One byte more than allowed shows that it is larger.
        raw = response.read(MAX_ANSWER_BYTES + 1)
        # http.client returns what came without an error if a connection ends early.
        if response.length:
            raise http.client.IncompleteRead(raw, response.length)
        try:
            document = json.loads(raw) if len(raw) <= MAX_ANSWER_BYTES else None
        except (ValueError, RecursionError):
            document = None
        if not isinstance(document, dict):
            raise self.foreign_answer_error("no JSON object")
        return Fetched(document, response.headers.get("ETag", ""))

    def _refusal(self, response: http.client.HTTPResponse) -> RefusedError | UnreachableError:
        """Return the error for an answer that is a refusal."""
        try:
            problem = self._read(response).document
        except UnreachableError:
            problem = {}
        kind, detail = problem.get("type"), problem.get("detail")
        if isinstance(kind, str) and kind.startswith(_SAYS_PYRCAL) and isinstance(detail, str):
            return RefusedError(detail)
        found = f"{response.status} {response.reason}"
        if response.status in _BUSY:
            return UnreachableError(f"{self.url}: {found}: too many requests at once; try again")
        return self.foreign_answer_error(found)

    def foreign_answer_error(self, found: str) -> UnreachableError:
        """Return the error for an answer that is not pyrcal's."""
        return UnreachableError(
            f"{self.url}: something answers, but it is not pyrcal, or not this version: {found}"
        )


class _LostError(UnreachableError):
    """A request was sent, and no answer came."""


def _cut(sock: socket.socket, late: threading.Event) -> None:
    """End a connection, even if a thread waits for it."""
    late.set()
    try:
        # shutdown() wakes a thread that waits in recv(); close() does not.
        sock.shutdown(socket.SHUT_RDWR)
    except OSError:
        return  # the connection has already ended


def chunks(response: http.client.HTTPResponse) -> Iterator[bytes]:
    """Yield an answer piece by piece.

    Raises
    ------
    HTTPException
        If it ends too early.
    """
    while chunk := response.read(1 << 20):
        yield chunk
    if response.length:
        raise http.client.IncompleteRead(b"", response.length)
