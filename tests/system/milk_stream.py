"""Streams of cacao's at a rate, each frame full of its counter: what is lost or mixed up is seen.

``python -m tests.system.milk_stream DIR HZ N_SLOPES N_MODES SECONDS``
"""

import sys
import time
from pathlib import Path

import numpy as np

from tests.support.milk import Milk
from tests.system.milk_loop import path_of


def main(folder, hz, n_slopes, n_modes, seconds):
    slopes = Milk(path_of(folder, "aol1_imWFS2"), (n_slopes,), n_ring=round(hz), pid=1000)
    values = Milk(path_of(folder, "aol1_modevalWFS"), (n_modes,), n_ring=4, pid=2000)
    mirror = Milk(path_of(folder, "aol1_modevalDM"), (n_modes,), n_ring=round(hz), pid=3000)
    Milk(path_of(folder, "aol1_modesWFS"), (n_slopes, 1, n_modes)).put(np.ones(n_slopes * n_modes))
    sys.stdout.write("runs\n")
    sys.stdout.flush()
    start_s, n_frames = time.monotonic(), round(seconds * hz)
    for k in range(1, n_frames + 1):
        slopes.put(k)
        values.put(k, slopes)
        mirror.put(k, values, slopes)
        late_s = start_s + k / hz - time.monotonic()
        if late_s > 0:
            time.sleep(late_s)
    sys.stdout.write(f"wrote {n_frames} in {time.monotonic() - start_s:.2f} s\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:5]), float(sys.argv[5]))
