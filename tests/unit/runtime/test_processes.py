"""What travels between the service and its processes: arrays as they lie, never a copy of them."""

import tracemalloc
from functools import partial

import numpy as np

from service.runtime import processes
from service.runtime.processes import Worker

LARGE = np.arange(3_000_000, dtype=np.float32).reshape(1000, 3000)


def doubled(array):
    array *= 2  # it is its own
    return {"whole": array, "few": array[0, :3].copy(), "turned": array.T}


def test_an_array_is_sent_as_it_lies_and_may_be_written_to_where_it_comes():
    worker = Worker("tests.support.jobs")
    try:
        found = worker.do(partial(doubled, LARGE))
    finally:
        worker.kill()
    np.testing.assert_array_equal(found["whole"], 2 * LARGE)
    np.testing.assert_array_equal(found["turned"], 2 * LARGE.T)
    np.testing.assert_array_equal(found["few"], [0.0, 2.0, 4.0])
    found["whole"] += 1


class Line:
    """The end of a line that nobody reads."""

    def __init__(self):
        self.sizes = []

    def send_bytes(self, what):
        self.sizes.append(memoryview(what).nbytes)


def test_whoever_sends_an_array_takes_no_memory_for_it():
    line = Line()
    tracemalloc.start()
    try:
        processes._send(line, [LARGE, LARGE[:1], "words"])
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert LARGE.nbytes in line.sizes
    assert sum(line.sizes) < LARGE.nbytes + 20_000
    assert peak_bytes < 100_000
