"""How a program ends."""

import subprocess
import sys

from service.cli.program import leave

AT_ITS_END = "import atexit, sys; atexit.register(print, 'taken down'); "

WITH_A_CHILD = """
import multiprocessing, time
from service.cli.program import leave

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
