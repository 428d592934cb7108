"""What the running service does to its own process."""

import platform
import subprocess
import sys

import pytest
from structlog.testing import capture_logs

from service.cli.serve import warn_of_readers

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
