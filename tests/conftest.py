"""Settings that must hold before any test module imports numpy, and the order of the suite."""

import atexit
import gc
import os
import shutil
import signal
import tempfile

import pytest
import structlog
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling

from tests.support.pace import patience

# Two shared cores and several processes per test: nested BLAS threads make everything slower.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
# Nobody's own folder is written to, and the processes of a system test share what is prepared.
os.environ.setdefault(
    "PYRCAL_SERVICE__CACHE_DIR", os.path.join(tempfile.gettempdir(), f"pyrcal-tests-{os.getuid()}")
)
# An archive synchronises each write, which a shared disk answers in tens of milliseconds and memory
# at once: temporary folders lie in memory where there is plenty of it. No test pulls the plug.
_MEMORY = "/dev/shm"
if os.access(_MEMORY, os.W_OK) and shutil.disk_usage(_MEMORY).free > 4e9:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", _MEMORY)
# Services that others run on this machine are none of a test's.
os.environ["XDG_RUNTIME_DIR"] = tempfile.mkdtemp(prefix="pyrcal-tests-run-")
atexit.register(shutil.rmtree, os.environ["XDG_RUNTIME_DIR"], ignore_errors=True)
# A property that others slow down still holds: the limits of time are those of every test.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
# A shell's background job inherits SIGINT as ignored, and would hand it on to the programs that the
# system tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

ORDER = ("tests/unit/", "tests/properties/", "tests/physics/", "tests/system/")
"""What is known soonest comes first; one worker begins at the end."""

WAITING = "tests/system/"
"""Tests of processes: 370 s of time and 65 s of a processor, all one after the other."""

REAL_TIME = ("tests/system/test_demo.py", "tests/system/test_sim_rtc.py")
"""The full instrument at 1 kHz: one after the other, on one worker."""

LASTING = (
    "tests/system/test_page.py",  # one service for all its tests: they stay on one worker
    "tests/system/test_manual.py",
    "tests/system/test_commission.py",
    "tests/system/test_replay.py",
    "tests/system/test_worker.py",
    "tests/system/test_faults.py",
    "tests/system/test_harm.py",
)
"""Long tests of a minute and more, longest first: started late, they would leave workers idle."""

MAX_UNSTABLE = 3
"""Largest number of system tests that may pass at the second try only."""

SHARED = (
    "tests/system/test_broken_messages.py",
    "tests/system/test_page.py",
    "tests/system/test_rest.py",
)
"""Their tests share a service; every other system test has its own, and may run anywhere."""


@pytest.fixture
def archive(tmp_path):
    """Give an archive that is open, in a folder of the test's own."""
    from service.archive import Archive

    archive = Archive(tmp_path)
    archive.open()
    with archive:
        yield archive


@pytest.fixture
async def client(service):
    """Give whoever asks REST of a test's own service, in this process."""
    import httpx  # most tests need neither

    from service.api import create_app

    transport = httpx.ASGITransport(create_app(service), raise_app_exceptions=False)
    async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
        yield client


@pytest.fixture(autouse=True)
def undeclared_transitions_raise(monkeypatch):
    """Fail a test in which a state changes in a way that no table declares."""
    from service.tracking import transitions

    def fail(_, record, to):
        raise AssertionError(f"a {type(record).__name__} has no declared transition to {to}")

    monkeypatch.setattr(transitions, "report_undeclared", fail)


@pytest.fixture(autouse=True)
def invariants_hold(monkeypatch):
    """Fail a test after whose steps the state violates an invariant."""
    from service.tracking import alarm_records, invariants

    update = alarm_records.update_records  # the last thing that a step does

    def update_and_validate(context, **options):
        update(context, **options)
        assert invariants.find_violations(context.state) == []

    monkeypatch.setattr(alarm_records, "update_records", update_and_validate)


@pytest.fixture(autouse=True)
def log_of_its_own():
    """Leave no log behind that writes where the test before has looked."""
    yield
    structlog.reset_defaults()


def pytest_ignore_collect(collection_path, config):
    """Import no file without a long test where only those are asked for, four times over."""
    if _only_long(config) and collection_path.match("test_*.py"):
        return "mark.long" not in collection_path.read_text(encoding="utf-8") or None
    return None


def pytest_collection_modifyitems(config, items):
    """Put them in order, and give them the time that they need on this machine."""
    place = _place_among_long if _only_long(config) else _place
    items.sort(key=lambda item: place(item.nodeid))
    for item in items:
        marked = item.get_closest_marker("timeout")
        limit_s = marked.args[0] if marked else float(config.getini("timeout"))
        in_system = item.get_closest_marker("system") is not None
        # of each try, not of the first one and the second together
        limit = pytest.mark.timeout(patience(limit_s), func_only=in_system)
        item.add_marker(limit, append=False)
        if in_system:
            # Real processes in real time on a machine that others use: a stall of a moment may fail
            # a test once. Everything else runs once, so that a race condition turns red.
            item.add_marker(pytest.mark.flaky(reruns=1))


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among thousands of tests, neither now nor later: they stay."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


def pytest_terminal_summary(terminalreporter):
    """Print why a test that passed at its second try failed at the first, and how many did."""
    for report in terminalreporter.getreports("rerun"):
        terminalreporter.write_sep("_", f"first try of {report.nodeid}")
        terminalreporter.line(report.longreprtext)
    if unstable := _unstable(terminalreporter):
        limit = f" (more than {MAX_UNSTABLE} make the run fail)"
        terminalreporter.line(f"unstable: {len(unstable)}{limit}: {', '.join(sorted(unstable))}")


def pytest_sessionfinish(session):
    """Fail a run in which too many tests needed a second try: that is no moment's stall."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter and session.exitstatus == 0 and len(_unstable(reporter)) > MAX_UNSTABLE:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _unstable(reporter):
    """Return the ids of the tests that failed at the first try and passed at the second."""
    passed = {report.nodeid for report in reporter.getreports("passed")}
    return passed & {report.nodeid for report in reporter.getreports("rerun")}


def _only_long(config):
    return config.option.markexpr.startswith("long")


def _place_among_long(nodeid):
    """What waits first; what computes fills the gaps in the end."""
    folder, is_other = _place(nodeid)
    first = (*REAL_TIME, *LASTING)
    place = next((k for k, name in enumerate(first) if nodeid.startswith(name)), len(first))
    return place, -folder, is_other


def _place(nodeid):
    folder = next((k for k, name in enumerate(ORDER) if nodeid.startswith(name)), len(ORDER))
    return folder, not nodeid.startswith(REAL_TIME)


class InOrder(LoadScopeScheduling):
    """Hands out whole modules in order, system tests one by one; outlives a worker that dies.

    With the quick tests one worker after the other is given system tests from the beginning: they
    wait more than they work, and the processors are the others' meanwhile.
    """

    one_waits = False

    def _assign_work_unit(self, node):
        if self.one_waits:
            waits = not any(
                scope.startswith(WAITING) and not all(unit.values())
                for other, units in self.assigned_work.items()
                for scope, unit in units.items()
                if other is not node
            )
            for scope in self.workqueue:
                if scope.startswith(WAITING) is waits:
                    self.workqueue.move_to_end(scope, last=False)
                    break
        super()._assign_work_unit(node)

    def _split_scope(self, nodeid):
        if nodeid.startswith(REAL_TIME):
            return "real time"
        alone = nodeid.startswith(WAITING) and not nodeid.startswith(SHARED)
        return nodeid if alone else nodeid.split("::")[0]

    def remove_node(self, node):
        """Put back only what is left to do: a new worker would wait for an empty unit."""
        units = self.assigned_work[node]
        for scope in [scope for scope, unit in units.items() if all(unit.values())]:
            del units[scope]
        return super().remove_node(node)

    def mark_test_pending(self, item):
        """Allow the second try of a test that has ended its worker: it is put back already."""

    def _reschedule(self, node):
        """Give a new worker more than one: it begins none before it knows the next."""
        while True:
            left = len(self.workqueue)
            super()._reschedule(node)
            if len(self.workqueue) in {left, 0}:
                return


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Hand out tests in the order of this suite."""
    config.option.loadscopereorder = False
    scheduler = InOrder(config, log)
    scheduler.one_waits = not _only_long(config)
    return scheduler
