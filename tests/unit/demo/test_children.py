import os
import signal
import time

import pytest

from pyrcal.demo.children import GRACE_S, interrupt_on_end, run_children
from tests.support.night import session_members, wait_for
from tests.support.pace import in_time

WITH_A_CHILD = """
import subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(100)"])
print("there", flush=True)
time.sleep(100)
"""
DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN);" + WITH_A_CHILD


def started(child):
    wait_for(lambda: "there" in child.log.read_text(encoding="utf-8"), 20.0, "the child is there")
    return child.process.pid


@pytest.mark.parametrize("how", ["ends", "deaf", "stopped"])
def test_whatever_the_children_do_they_and_theirs_are_gone_within_the_grace(tmp_path, how):
    program = DEAF if how == "deaf" else WITH_A_CHILD
    commands = {name: ["-c", program] for name in ("service", "simulator")}
    with run_children(tmp_path, commands) as both:
        leaders = [started(child) for child in both]
        assert all(len(session_members(leader)) == 2 for leader in leaders)
        if how == "stopped":
            for leader in leaders:
                for member in session_members(leader):
                    os.kill(member, signal.SIGSTOP)
        began_s = time.monotonic()
    assert in_time(began_s, GRACE_S + 1.0)
    wait_for(lambda: not any(session_members(leader) for leader in leaders), 20.0, "all gone")


def test_a_child_that_ended_is_quoted(tmp_path):
    with run_children(tmp_path, {"service": ["-c", "print('why'); raise SystemExit(3)"]}) as (
        child,
    ):
        wait_for(lambda: child.ended, 20.0, "an end")
        assert child.ended == "the service ended with status 3: why"


def test_an_impatient_second_interrupt_leaves_nothing_behind(tmp_path):
    with run_children(tmp_path, {"service": ["-c", DEAF]}) as (child,):
        leader = started(child)
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        before = signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    signal.signal(signal.SIGALRM, before)
    wait_for(lambda: not session_members(leader), 20.0, "all gone")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_closed_terminal_or_a_kill_interrupts_like_ctrl_c(number):
    before = signal.getsignal(number)
    with interrupt_on_end(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)
    assert signal.getsignal(number) is before
