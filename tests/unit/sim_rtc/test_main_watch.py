import re
import threading
import time
from types import SimpleNamespace

import numpy as np
from structlog.testing import capture_logs

from sim_rtc.computer.telemetry import Pace
from sim_rtc.options import parse_options
from sim_rtc.simulator import Watch
from tests.support.pace import Deadline

COMPUTER = SimpleNamespace(reconstructor=SimpleNamespace(manifest=SimpleNamespace(id="cm")))


def batch(k):
    return SimpleNamespace(n_clipped=0, seq0=50 * k, slopes=np.empty((50, 1)))


def test_a_loop_that_falls_behind_says_so_at_once_by_how_much_and_when_it_is_over():
    pace, stopped = Pace(batch_s=0.05, batch_frames=50), threading.Event()
    watch = Watch(
        COMPUTER,
        pace,
        SimpleNamespace(n_dropped_frames=0),
        parse_options(["--rate", "1000"]),
    )

    def play(k, work_s=0.0):
        pace.wait(stopped)
        time.sleep(work_s)
        pace.done()
        watch.look(batch(k))

    with capture_logs() as logged:
        play(0)
        assert not logged
        play(1, work_s=0.8)
        (told,) = [line for line in logged if line["event"] == "loop.behind"]
        assert told["log_level"] == "warning"
        assert told["behind_s"] > 0.5
        # 100 frames in some 0.9 s
        (share,) = re.findall(r"(\d+) % of it was kept", told["text"])
        assert 3 <= int(share) <= 12
        k, deadline = 2, Deadline(20.0)
        while pace.behind_s > 0.1:
            assert not deadline.passed
            play(k)
            k += 1
        watch.report()
    assert [line["event"] for line in logged if line["log_level"] == "warning"] == [
        "loop.behind",
        "loop.on-time",
    ]
