"""``pyrcal check-rtc`` beside an RTC, both as processes of their own."""

import json
import re

import numpy as np

from tests.support.cable import free_port
from tests.support.night import ALPHA, INSTRUMENT, N_START, Process
from tests.support.pace import slowness
from tests.support.stranger import small_telescope


def write_plant(path):
    """Write a telescope whose mirror lies at ALPHA, and a matrix that thinks it lies at 0."""
    response, variance_m2 = small_telescope(**ALPHA)
    assumed, _ = small_telescope()
    matrix = np.linalg.pinv(assumed[:, :N_START])
    np.savez(path, response=response, sigma_m=np.sqrt(variance_m2), matrix=matrix)
    return path


def checked_beside(folder, rtc_words, *options):
    """The same of an RTC that a module and its words start."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = ["pyrcal", "check-rtc", "--instrument", str(INSTRUMENT), "--listen", endpoint]
    check = Process("check", [*words, "--json", *options], folder)
    rtc = Process("rtc", rtc_words(endpoint), folder)
    try:
        status = check.ended(90.0)
    finally:
        rtc.kill()
        check.kill()
    told = json.loads(check.log[check.log.index("{") : check.log.rindex("}") + 1])
    return status, {one["check"]: one for one in told["checks"]}, check.log


def late_with_the_machine(delivery):
    """Whether a busy machine is why frames came late: the RTC runs on it, too."""
    late_ms = re.search(r"at most (\d+) ms", delivery["found"])
    slower = slowness(again=True)
    return late_ms is not None and slower > 1.2 and int(late_ms[1]) < 500 * slower
