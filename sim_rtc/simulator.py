"""Run the simulated RTC and telescope, write their instrument file, or replay a recording."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import structlog
from threadpoolctl import threadpool_limits

from service.errors import ConfigurationError
from service.files.recording import Recording, RecordingWriter
from service.instrument import load_instrument
from service.program import log_to_terminal, status_of, stop_signal
from sim_rtc.assembly import Telescope, at_held_rate, build_telescope
from sim_rtc.computer.feed import Ahead, message_frames
from sim_rtc.computer.real_time_computer import RealTimeComputer
from sim_rtc.computer.telemetry import Batch, FrameClock, Pace
from sim_rtc.faults import ComputerFaults, FaultPlan
from sim_rtc.link.link import Link
from sim_rtc.link.replay import Replay
from sim_rtc.options import Options, parse_options
from sim_rtc.rehearsal import write_live_instrument
from sim_rtc.telescope.measured import MeasuredPlant
from sim_rtc.truth import TruthRecorder

_REPORT_PERIOD_S = 10.0
_WORRYING_DELAY_S = 0.5
_log = structlog.get_logger("sim_rtc")


def simulate(arguments: Sequence[str] | None = None) -> int:
    """Run the simulated RTC for its time or until a signal; return the exit status."""
    options = parse_options(arguments)
    log_to_terminal(quiet=options.quiet)
    stopped = stop_signal()
    return status_of(lambda: _build_and_run(options, stopped), "sim_rtc")


def _build_and_run(options: Options, stopped: threading.Event) -> int:
    if options.replay is not None:
        return _replay(options.replay, options, stopped)
    if options.write_instrument is not None:
        write_live_instrument(options.instrument, options.write_instrument, options.given_modes)
        return 0
    instrument = load_instrument(options.instrument)
    _check_writable(options.truth)
    if options.held_rate and options.plant != "diffractive":
        options = at_held_rate(options, instrument)
    # Nested threading makes small products slower, and the service needs the other core.
    with threadpool_limits(1):
        telescope = build_telescope(
            options, instrument, batch_frames=message_frames(options.frame_rate_hz)
        )
        if isinstance(telescope.plant, MeasuredPlant):
            _report_matrix(telescope.plant, options)
        run(telescope, options, stopped)
    return 0


def run(telescope: Telescope, options: Options, stopped: threading.Event) -> None:
    """Run the loop in this thread until ``stopped`` or the time is up."""
    batch_frames = telescope.feed.batch_frames
    batch_s = batch_frames / options.frame_rate_hz / options.speed if options.speed else 0.0
    pace = Pace(batch_s=batch_s, batch_frames=batch_frames)
    with ExitStack() as stack:
        ahead = stack.enter_context(Ahead(telescope.feed.blocks()))
        computer = telescope.computer(iter(ahead))
        # Before the clock starts: the first blocks take seconds, which the timestamps must not
        # contain.
        computer.prepare()
        clock = FrameClock(start_ns_utc=time.time_ns(), dt_ns=round(1e9 / options.frame_rate_hz))
        plan, recorder = FaultPlan(options.faults), None
        if options.record is not None:
            system = computer.identity.system
            recorder = stack.enter_context(RecordingWriter(options.record, system=system))
        link = stack.enter_context(
            Link(computer, options, telescope.detector, clock=clock, plan=plan, recorder=recorder)
        )
        truth = None
        if options.truth is not None:
            truth_recorder = TruthRecorder(
                options.truth,
                weights=telescope.weights,
                points_m=telescope.plant.points_m,
                clock=clock,
                options=options,
                image_offsets_px=telescope.plant.image_offsets_px,
            )
            truth = stack.enter_context(truth_recorder)
        computer_faults = ComputerFaults(
            plan, computer, clock=clock, pace=pace, absence=link.absence
        )
        last_batch = float("inf")
        if options.seconds is not None:
            last_batch = round(options.seconds * options.frame_rate_hz / batch_frames)
        watch = Watch(computer, pace, link, options)
        n_batches = 0
        _log.info("loop.start", rate_hz=options.frame_rate_hz, session=computer.session)
        while not stopped.is_set() and n_batches < last_batch:
            pace.wait(stopped)
            computer_faults.before_batch(n_batches * batch_frames / options.frame_rate_hz, stopped)
            batch = computer.next_batch()
            link.offer(batch)
            if truth is not None:
                truth.offer(batch, pace.late_frames, pace.behind_s)
            pace.done()
            watch.look(batch)
            n_batches += 1
        watch.report()


def _report_matrix(plant: MeasuredPlant, options: Options) -> None:
    """Log what was decided about a measured matrix, and what is not known of it."""
    for note in plant.measured.notes:
        _log.info("matrix.note", text=note)
    if not plant.knows_orientation:
        text = (
            'slopes.orientation is "auto": the sensor sees only what the measured modes can make '
            "of the turbulence; state the orientation that pyrcal fit finds to add the rest"
        )
        _log.info("matrix.note", text=text)
    if options.alpha is None:
        text = (
            "the true registration is not known: compare the service's with that of pyrcal fit "
            f"{options.instrument} {options.matrix}"
        )
        _log.info("matrix.truth-unknown", text=text)


def _replay(path: Path, options: Options, stopped: threading.Event) -> int:
    with Recording(path) as recording:
        Replay(recording, router=options.router, speed=options.speed).run(stopped)
    return 0


class Watch:
    """Logs the loop's health every few seconds, and at once when it falls behind."""

    def __init__(
        self, computer: RealTimeComputer, pace: Pace, link: Link, options: Options
    ) -> None:
        self._computer = computer
        self._pace = pace
        self._link = link
        self._rate_hz = options.frame_rate_hz * (options.speed or 1.0)
        self._since_s = time.monotonic()
        self._cpu_s = time.process_time()
        self._seq = 0
        self._frames = 0
        self._clipped = 0
        self._late = 0
        self._behind = False

    def look(self, batch: Batch) -> None:
        """Count a batch."""
        self._clipped += batch.n_clipped
        self._frames += len(batch.slopes)
        self._seq = batch.seq0 + len(batch.slopes)
        fell_behind = self._pace.behind_s > _WORRYING_DELAY_S and not self._behind
        if fell_behind or time.monotonic() - self._since_s >= _REPORT_PERIOD_S:
            self.report()

    def report(self) -> None:
        """Log what has happened since the last report."""
        now_s, cpu_s = time.monotonic(), time.process_time()
        elapsed_s = max(now_s - self._since_s, 1e-9)
        _log.info(
            "loop.report",
            frames=self._seq,
            cm_id=self._computer.reconstructor.manifest.id,
            cpu_per_second=round((cpu_s - self._cpu_s) / elapsed_s, 3),
            overrun_frames=self._pace.late_frames - self._late,
            unpublished_frames=self._link.n_dropped_frames,
        )
        if self._clipped:
            _log.warning("loop.clipped", commands=self._clipped, text="the loop may diverge")
        self._tell_delay(self._frames / elapsed_s / self._rate_hz)
        self._since_s, self._cpu_s, self._clipped = now_s, cpu_s, 0
        self._late, self._frames = self._pace.late_frames, 0

    def _tell_delay(self, share: float) -> None:
        """Log how far behind real time the loop is, and when it has caught up."""
        behind_s = self._pace.behind_s
        if behind_s > _WORRYING_DELAY_S:
            text = (
                f"{behind_s:.1f} s behind real time; {100 * share:.0f} % of it was kept of late: "
                "telemetry comes late and in bursts; leave this machine more of a processor, or "
                "ask for less with --rate or --speed"
            )
            _log.warning("loop.behind", behind_s=round(behind_s, 2), text=text)
        elif self._behind:
            _log.warning("loop.on-time", text="in real time again")
        self._behind = behind_s > _WORRYING_DELAY_S


def _check_writable(path: Path | None) -> None:
    """Refuse a truth file that cannot be written before seconds are spent on the optics."""
    if path is None:
        return
    try:
        path.open("w", encoding="utf-8").close()
    except OSError as error:
        raise ConfigurationError(f"--truth: cannot write {path}: {error.strerror}") from error
