"""Settings that must hold before any test module imports numpy."""

import os
import signal
import tempfile

import pytest

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


def pytest_collection_modifyitems(items):
    """Keep together what two workers must not share out: a module, and all real processes.

    System tests run in real time, one after the other; the other worker is a busy loop beside them.
    """
    for item in items:
        alone = item.get_closest_marker("system") is not None
        item.add_marker(pytest.mark.xdist_group("system" if alone else item.nodeid.split("::")[0]))
