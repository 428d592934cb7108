"""An RTC built on ``pyrcal.rtc``: an integrator with a delay of two frames on a linear telescope.

Run: ``python -m examples.rtc_with_library ENDPOINT SYSTEM PLANT.npz``. PLANT.npz contains the
telescope (see examples/telescope.py) and the first control ``matrix`` (n_controlled, n_slopes).
"""

import sys
import time

import numpy as np

from examples.telescope import Telescope
from pyrcal import rtc

RATE_HZ, BATCH = 500.0, 10


def expose(computer, telescope, commands_m):
    """Run one batch of frames through the loop; return its telemetry.

    ``commands_m`` (2, n_modes) are the commands of the next two exposures.
    """
    dither_m = computer.begin_batch(BATCH)
    matrix, slopes, played_m = computer.reconstructor.matrix, [], []
    n_controlled = len(matrix)
    if not computer.closed:
        commands_m[:] = 0.0
    for frame_m, offset in zip(dither_m, computer.reference_offset(), strict=True):
        played_m.append(commands_m[0] + frame_m)
        # The service may set reference slopes: the offset is subtracted beyond the RTC's own.
        slopes.append(telescope.expose(played_m[-1]) - offset)
        answer_m = computer.leak * commands_m[1]
        answer_m[n_controlled:] = 0.0
        if computer.closed:
            answer_m[:n_controlled] -= computer.gains[:n_controlled] * (matrix @ slopes[-1])
        commands_m[:] = commands_m[1], answer_m
    return computer.end_batch(slopes, played_m, dither_m)


def main(endpoint, system, file):
    """Run the loop in real time until the program is stopped."""
    plant = np.load(file)
    telescope, n_modes = Telescope(plant), plant["response"].shape[1]
    computer = rtc.BasicComputer(
        rtc.Identity(system=system, basis_id="plant-1", config_id="plant-1"),
        plant["matrix"],
        gains=np.where(np.arange(n_modes) < len(plant["matrix"]), 0.4, 0.0),
        leak=0.99,
        frame_rate_hz=RATE_HZ,
        delay_frames=2.0,
        max_dither_m=50e-9,
    )
    connection = rtc.RtcConnection(
        computer, rtc.Router(endpoint=endpoint), batches_per_s=RATE_HZ / BATCH
    )
    commands_m, next_status_s = np.zeros((2, n_modes)), 0.0
    while True:
        with connection.open() as link:
            while not link.is_lost():
                link.publish_frames(*expose(computer, telescope, commands_m))
                if computer.has_swapped:
                    link.report_matrices()
                if time.monotonic() >= next_status_s:
                    link.publish_status(computer.status())
                    next_status_s = time.monotonic() + rtc.STATUS_PERIOD_S
                time.sleep(max(0.0, (computer.time_ns(computer.seq) - time.time_ns()) / 1e9))


if __name__ == "__main__":
    main(*sys.argv[1:])
