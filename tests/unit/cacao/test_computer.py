"""What the bridge makes of a loop whose streams somebody else has written, also wrong ones."""

import subprocess
import sys

import numpy as np
import pytest

from cacao_bridge.computer import Cacao
from service.wire import Loop
from tests.support.calibration import INDEX, N_MODES, SHAPE, settings_in
from tests.support.milk import Milk

ROWS, GAIN, MULT = 3, 0.4, 0.9


class Loops:
    """A loop of cacao's, frame by frame, and the bridge that looks at it."""

    def __init__(self, folder, reference=None, **law):
        def stream(name, *size, **more):
            return Milk(folder / f"{name}.im.shm", size, **more)

        settings = settings_in(folder)
        settings = settings.model_copy(update={"loop": settings.loop.model_copy(update=law)})
        if reference is not None:
            named = settings.streams.model_copy(update={"reference": "aol1_wfsrefc"})
            settings = settings.model_copy(update={"streams": named})
            self.reference = stream("aol1_wfsrefc", *SHAPE[::-1])
            self.reference.put(np.full(SHAPE, reference))
        stream("aol1_modesWFS", *SHAPE[::-1], ROWS).put(np.ones((ROWS, *SHAPE)))
        for name, value in (("aol1_mgain", GAIN), ("aol1_mmult", MULT)):
            stream(name, ROWS, 1).put(np.full(ROWS, value))
        self.slopes = stream("aol1_imWFS2", *SHAPE[::-1], n_ring=32)
        self.values = stream("aol1_modevalWFS", ROWS, 1, n_ring=32)
        self.commands = stream("aol1_modevalDM", ROWS, 1, n_ring=32)
        self.rtc = Cacao(settings)
        self.frame(1.0)
        self.rtc.poll()

    def frame(self, command, n=1):
        for _ in range(n):
            self.slopes.put(np.full(SHAPE, float(self.slopes.md.cnt0)))
            self.values.put(np.zeros(ROWS), self.slopes)
            self.commands.put(np.full(ROWS, command), self.values, self.slopes)

    def rows(self, command):
        """Play 80 frames: rows without a command wait for 64."""
        sent = []
        for _ in range(4):
            self.frame(command, 20)
            sent += [rows for _, rows in self.rtc.poll()]
        return np.concatenate(sent) if sent else np.empty((0, 0))

    def stands(self, role):
        """Let a second have passed without a frame of it."""
        self.rtc._moved_s[role] -= 1.5
        self.rtc.poll()
        return self.rtc.complaint


@pytest.fixture
def loop(tmp_path):
    return Loops(tmp_path)


@pytest.fixture
def gone():
    """The number of a process that has been."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def test_the_status_tells_the_law_of_either_filter(tmp_path):
    for law, gain in (("mult c - gain m", GAIN), ("mult (c - gain m)", GAIN * MULT)):
        folder = tmp_path / law
        folder.mkdir()
        loop = Loops(folder, law=law)
        status = loop.rtc.status()
        assert status.loop is Loop.CLOSED
        assert status.leak == pytest.approx(MULT)
        np.testing.assert_allclose(status.gains, [gain] * ROWS + [0.0] * (N_MODES - ROWS))


def test_rows_hold_the_slopes_and_the_command_on_the_mirror(loop):
    rows = loop.rows(0.5)
    assert rows.shape[1] == len(INDEX) + N_MODES
    np.testing.assert_array_equal(rows[:, 0], np.arange(81 - len(rows), 81))
    np.testing.assert_allclose(rows[1:, len(INDEX) : len(INDEX) + ROWS], 0.5e-6)
    assert not loop.rtc.complaint


def test_a_new_reference_has_a_name_and_rows_of_neither_are_left_out(tmp_path):
    loop = Loops(tmp_path, reference=0.1)
    loop.rows(0.5)
    first, session = loop.rtc.status().reference_id, loop.rtc.session
    loop.reference.put(np.full(SHAPE, 0.1))  # written again, with the same numbers
    loop.rows(0.5)
    assert loop.rtc.status().reference_id == first
    loop.frame(0.5, 5)
    loop.reference.put(np.full(SHAPE, 0.2))
    n_known = loop.rtc.n_unpaired
    loop.rtc.poll()
    before = loop.rtc.n_unpaired
    assert before > n_known
    sent = []
    for _ in range(4):
        loop.frame(0.5, 20)
        sent += loop.rtc.poll()
    second = loop.rtc.status().reference_id
    assert second != first
    assert {header.reference_id for header, _ in sent} == {second}
    assert (loop.rtc.n_unpaired, loop.rtc.session) == (before, session)
    loop.reference.put(np.full(SHAPE, 0.1))
    loop.rtc.poll()
    assert loop.rtc.status().reference_id == first


def test_a_loop_switched_off_is_open_and_goes_on_in_its_session(loop):
    loop.rows(0.5)
    session = loop.rtc.session
    assert loop.stands("commands") == (
        "aol1_modevalDM: its counter stays at 81; is the loop on (loopON)?"
    )
    assert loop.rtc.status().loop is Loop.OPEN
    loop.rows(0.5)
    assert (loop.rtc.status().loop, loop.rtc.session) == (Loop.CLOSED, session)
    assert not loop.rtc.complaint


def test_a_loop_set_to_zero_is_another_session(loop):
    loop.rows(0.5)
    session = loop.rtc.session
    loop.frame(0.0, 5)
    assert loop.rtc.poll() == []
    assert loop.rtc.complaint.startswith("aol1_modevalDM: set to zero (loopZERO)")
    loop.rows(0.1)  # linked again
    assert len(loop.rows(0.1))
    assert loop.rtc.session != session
    again = loop.rtc.session
    loop.rows(0.1)
    assert (loop.rtc.session, loop.rtc.complaint) == (again, "")


def test_a_counter_that_stands_is_told_with_the_writer_that_has_ended(loop, gone):
    loop.rows(0.5)
    assert loop.stands("slopes") == "aol1_imWFS2: its counter stays at 81"
    loop.rows(0.5)
    loop.slopes.pid = gone
    loop.frame(0.5)
    loop.rtc.poll()
    ended = f"process {gone}, which wrote it, has ended"
    assert loop.stands("slopes") == f"aol1_imWFS2: its counter stays at 162; {ended}"


def test_a_writer_that_ended_in_the_midst_of_a_frame_is_named(loop, gone):
    loop.rows(0.5)
    loop.slopes.pid = gone
    loop.frame(0.5)
    loop.slopes.md.write = 1  # held for ever
    assert loop.rtc.poll() == []
    assert f"process {gone}, which wrote it, has ended" in loop.stands("slopes")


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("version", b"1.00", "found version '1.00', expected '2.00': create it again"),
        ("location", 1, "found its data in the memory of GPU 1, expected a stream in the host's"),
    ],
)
def test_a_stream_that_cannot_be_read_is_told_with_what_to_do(loop, field, value, told):
    loop.rows(0.5)
    session = loop.rtc.session
    again = Milk(loop.slopes.path, SHAPE[::-1], n_ring=32)  # cacao was started anew
    setattr(again.md, field, value)
    for _ in range(2):  # gone, and what is there instead
        assert loop.rtc.poll() == []
    assert told in loop.rtc.complaint
    assert loop.rtc.status().trouble == loop.rtc.complaint
    assert loop.rtc.session != session
