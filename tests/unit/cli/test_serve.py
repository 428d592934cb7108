"""What the running service does to its own process."""

import asyncio
import contextlib
import platform
import socket
import subprocess
import sys

import pytest
from structlog.testing import capture_logs

from service.cli import serve
from service.cli.serve import warn_of_readers
from service.config.settings import ApiTable
from service.errors import ConfigurationError
from tests.support.pace import patience

POOLS_OF_MANY_THREADS = """
import ctypes, threading
from service.cli.serve import share_memory

share_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
together = threading.Barrier(12)

def work():
    together.wait()
    mine = [libc.malloc(2000) for _ in range(100)]
    together.wait()
    for place in mine:
        libc.free(place)

threads = [threading.Thread(target=work) for _ in range(12)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
libc.fdopen.restype = ctypes.c_void_p
out = libc.fdopen(1, b"w")
libc.malloc_info(0, ctypes.c_void_p(out))
libc.fflush(ctypes.c_void_p(out))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only the GNU C library has pools")
def test_many_threads_share_two_pools_of_memory():
    # those that imports have begun before count as well
    words = [sys.executable, "-c", POOLS_OF_MANY_THREADS]
    told = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60.0).stdout
    assert 1 <= told.count("<heap nr=") <= 3


@pytest.mark.parametrize(("mode", "n_warnings"), [(0o700, 0), (0o750, 0), (0o755, 1), (0o701, 1)])
def test_a_data_folder_that_others_can_read_is_named_with_what_to_do(tmp_path, mode, n_warnings):
    tmp_path.chmod(mode)
    with capture_logs() as told:
        warn_of_readers(tmp_path)
    assert len(told) == n_warnings
    assert all(f"chmod 700 {tmp_path}" in line["text"] for line in told)


class Waiting:
    """What a supervisor is told of REST."""

    def __init__(self):
        self.texts, self.told = [], asyncio.Event()

    def await_rest(self, missing):
        self.texts.append(missing)
        self.told.set()


async def test_rest_listens_once_its_port_is_free(monkeypatch):
    monkeypatch.setattr(serve, "REST_RETRY_INTERVAL_S", 0.01)
    told, over = Waiting(), asyncio.Event()
    with contextlib.ExitStack() as holding:
        busy = holding.enter_context(socket.create_server(("127.0.0.1", 0)))
        port = busy.getsockname()[1]
        listening = asyncio.create_task(serve._listener(ApiTable(port=port), told, over))
        async with asyncio.timeout(patience(10.0)):
            await told.told.wait()
            assert (
                f"api.port: cannot listen on 127.0.0.1:{port}: Address already in use"
                in (told.texts[0])
            )
            assert "--port" in told.texts[0]
            holding.close()
            with await listening as listener:
                assert listener.getsockname()[1] == port
    assert told.texts[-1] == ""


async def test_a_service_that_waits_for_its_port_can_be_ended(monkeypatch):
    monkeypatch.setattr(serve, "REST_RETRY_INTERVAL_S", 0.01)
    told, over = Waiting(), asyncio.Event()
    with socket.create_server(("127.0.0.1", 0)) as busy:
        settings = ApiTable(port=busy.getsockname()[1])
        listening = asyncio.create_task(serve._listener(settings, told, over))
        async with asyncio.timeout(patience(10.0)):
            await told.told.wait()
            over.set()
            assert await listening is None


async def test_a_port_that_this_user_may_not_have_is_refused(monkeypatch):
    def refuse(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(socket, "create_server", refuse)
    with pytest.raises(ConfigurationError, match=r"127\.0\.0\.1:80: Permission denied.*--port"):
        await serve._listener(ApiTable(port=80), Waiting(), asyncio.Event())


async def test_a_failure_is_named_even_if_the_end_takes_too_long(monkeypatch):
    left = asyncio.Event()
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(serve, "END_WITHIN_S", 0.01)
    monkeypatch.setattr(serve, "leave", lambda _: loop.call_soon_threadsafe(left.set))
    monkeypatch.setattr(serve.signal, "signal", lambda *_: None)
    with capture_logs() as lines:
        ending = serve._Ending()
        refusal = ConfigurationError("mirror.stroke: found unknown")
        ending.failures = [ExceptionGroup("tasks", [refusal])]
        ending.begin()
        async with asyncio.timeout(patience(10.0)):
            await left.wait()
    assert [line["text"] for line in lines if line["event"] == "service.failed"] == [str(refusal)]
