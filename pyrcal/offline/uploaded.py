"""``python -m pyrcal.offline.uploaded FOLDER``: the process of an uploaded fit.

Nothing large is imported before the process is nice and knows how much memory it may have.
"""

from __future__ import annotations

import os
import resource
import sys
import threading
from pathlib import Path

from service.errors import PyrcalError
from service.files.fit_folder import FitRequest, read_request

DONE, FAILED = 0, 2


def main(folder: Path) -> int:
    """Fit the upload in the folder, and return the exit status."""
    request = read_request(folder)
    _keep_within(request)
    try:
        from pyrcal.offline.fit_upload import fit_upload

        fit_upload(folder, request)
    except PyrcalError as error:
        return _failed(str(error))
    except (MemoryError, SystemError):  # the latter: an extension module got no memory
        return _failed(f"needs more memory than {request.memory_mb} MB, the most it may have")
    except Exception as error:  # noqa: BLE001 - sent home, where it is a failed fit
        return _failed(f"failed unforeseen: {error!r}")
    return DONE


def _keep_within(request: FitRequest) -> None:
    """Be as nice as asked, take no more memory, and be gone when the service is gone."""
    os.nice(request.nice)
    most_bytes = request.memory_mb * 1_000_000
    resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, most_bytes))
    threading.Thread(target=_follow_service, daemon=True).start()


def _follow_service() -> None:
    """End with the service, even when it was killed: it holds the other end of standard input."""
    sys.stdin.buffer.read()
    os._exit(FAILED)


def _failed(why: str) -> int:
    sys.stderr.buffer.write(f"{why}\n".encode())
    return FAILED


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # the thread that follows the service holds standard input
