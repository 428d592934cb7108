"""Settings that must hold before any test module imports numpy."""

import os
import signal
import tempfile

import pytest
import structlog
from xdist.scheduler import LoadScopeScheduling

# Two shared cores and several processes per test: nested BLAS threads make everything slower.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
# Nobody's own folder is written to, and the processes of a system test share what is prepared.
os.environ.setdefault(
    "PYRCAL_SERVICE__CACHE_DIR", os.path.join(tempfile.gettempdir(), f"pyrcal-tests-{os.getuid()}")
)
# A shell's background job inherits SIGINT as ignored, and would hand it on to the programs that the
# system tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def log_of_its_own():
    """Leave no log behind that writes where the test before has looked."""
    yield
    structlog.reset_defaults()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Hand out whole modules, and all that runs in real time to one worker.

    System tests run one after the other; the other worker is a busy loop beside them.
    """

    class ByModule(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            module = nodeid.split("::")[0]
            return "tests/system" if module.startswith("tests/system/") else module

    return ByModule(config, log)
