"""How a program ends."""

import resource
import subprocess
import sys

import pytest

from service.program import leave, status_of

AT_ITS_END = "import atexit, sys; atexit.register(print, 'taken down'); "

WITH_A_CHILD = """
import multiprocessing, time
from service.program import leave

if __name__ == "__main__":
    context = multiprocessing.get_context("fork")
    child = context.Process(target=time.sleep, args=(600.0,))
    child.start()
    print("written", end="")
    leave(3)
"""


def ended(code, *words):
    """What a program has said, and its status; whoever holds its output open has ended, too."""
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)


def test_what_was_written_is_out_and_a_process_that_was_started_ends_with_it():
    found = ended(WITH_A_CHILD)
    assert (found.returncode, found.stdout) == (3, "written")


def test_a_service_does_not_wait_for_python_to_be_taken_down():
    run = f"{AT_ITS_END} from pyrcal.__main__ import main; main()"
    found = ended(run, "run", "--config", "nowhere.toml")
    assert (found.returncode, found.stdout) == (2, "")
    assert "nowhere.toml" in found.stderr


def test_it_is_the_end():
    assert "taken down" in ended(AT_ITS_END).stdout
    assert (
        "taken down"
        not in ended(f"{AT_ITS_END} from {leave.__module__} import leave; leave(0)").stdout
    )


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("can't start new thread"), OSError(12, "no memory")]
)
def test_too_small_a_limit_of_memory_is_one_line(monkeypatch, capsys, error):
    def task():
        raise error

    monkeypatch.setattr(resource, "getrlimit", lambda _: (300_000_000, -1))
    assert status_of(task) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "found a limit of 300 MB of memory, expected a gigabyte at least" in told
    monkeypatch.setattr(resource, "getrlimit", lambda _: (-1, -1))
    with pytest.raises(type(error)):  # of another kind: a fault, told with where it is
        status_of(task)
