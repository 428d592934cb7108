"""What tests of several modules share of unit.test_api_admission."""

from __future__ import annotations

import asyncio
import contextlib
import socket

from service.api import create_app
from service.web.connections import Server


@contextlib.asynccontextmanager
async def serving(service, keys=None, proxies=()):
    listener = socket.create_server(("127.0.0.1", 0))
    over = asyncio.Event()
    server = Server(create_app(service, keys=keys), over, within_s=2, proxies=proxies)
    service.crowd = server.crowd
    task = asyncio.create_task(server.serve(sockets=[listener]))
    while not server.started:  # noqa: ASYNC110 - uvicorn has no event for it
        await asyncio.sleep(0.01)
    try:
        yield listener.getsockname()[1]
    finally:
        over.set()
        await task
