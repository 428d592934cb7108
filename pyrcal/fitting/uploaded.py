"""``python -m pyrcal.fitting.uploaded FOLDER``: the process of an uploaded fit.

Large modules are imported after the process has lowered its priority.
"""

from __future__ import annotations

import os
import resource
import sys
import threading
from pathlib import Path

from service.errors import PyrcalError
from service.files.fit_folder import read_request

DONE, FAILED = 0, 2

ROOM_BYTES = 48_000_000
"""Memory beyond the imports that must be free before a fit starts: a BLAS buffer of a second
thread, and objects."""


def main(folder: Path) -> int:
    """Fit the upload in the folder, and return the exit status."""
    request = read_request(folder)
    os.nice(request.nice)
    threading.Thread(target=_follow_service, daemon=True).start()
    try:
        from pyrcal.fitting.fit_upload import fit_upload

        _limit_memory(request.memory_mb * 1_000_000)
        fit_upload(folder, request)
    except PyrcalError as error:
        return _report_failure(str(error))
    except (MemoryError, SystemError):  # SystemError: an extension module could not allocate memory
        return _report_failure(
            f"needs more memory than {request.memory_mb} MB, the most it may have"
        )
    except Exception as error:  # noqa: BLE001 - sent home, where it is a failed fit
        return _report_failure(f"failed unforeseen: {error!r}")
    return DONE


def _limit_memory(max_bytes: int) -> None:
    """Take no more memory from now on.

    Only after the imports, with BLAS's buffers taken and room for small objects: BLAS asks for
    ever for a buffer that it cannot have, and so does CPython 3.11 for 32 bytes while it unwinds
    its stack. An array that is too large is an error at once.

    Raises
    ------
    MemoryError
        If the imports have left no room.
    """
    import numpy as np
    import scipy.linalg

    for linalg in (np.linalg, scipy.linalg):  # each has a BLAS of its own
        linalg.inv(np.eye(64))
    page_bytes = resource.getpagesize()
    taken_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * page_bytes
    if taken_bytes + ROOM_BYTES > max_bytes:
        raise MemoryError
    resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, max_bytes))


def _follow_service() -> None:
    """End this process when the service ends, even if it is killed: standard input then closes."""
    sys.stdin.buffer.read()
    os._exit(FAILED)


def _report_failure(why: str) -> int:
    sys.stderr.buffer.write(f"{why}\n".encode())
    return FAILED


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # the thread that watches the service blocks on standard input
