"""A loop as cacao runs one, on streams alone: ``python -m tests.system.milk_loop DIR PLANT.npz``.

PLANT.npz: ``modes`` (n_modes, ny, nx), strokes of the actuators; ``response`` (rows, columns,
n_actuators) of a frame per metre of each actuator; ``sigma_m`` (n_modes,) of the turbulence; the
``matrix`` (n_controlled, rows * columns) of the start; ``noise`` of each value; ``hz`` frames a
second. A unit of the mirror is two micrometres of optical path. The loop copies the matrix when it
starts, and starts again, as another process, when somebody has made ``aol1_modesWFS`` anew.
"""

import sys
import time
from pathlib import Path

import numpy as np

from tests.support.milk import Milk

HZ, GAIN, MULT, UNIT, RING = 500.0, 0.4, 0.99, 2e-6, 128


def path_of(folder, name):
    return folder / f"{name}.im.shm"


def values_in(path):
    """What the first frame of a stream of floats holds, in the order of memory."""
    data = path.read_bytes()
    sizes = np.frombuffer(data, "<u4", 3, 116)[: data[112]]
    return np.frombuffer(data, "<f4", int(np.prod(sizes)), 384).reshape(sizes[::-1])


def main(folder, plant):
    sigma_m, grid = plant["sigma_m"], plant["modes"].shape[1:]
    modes = plant["modes"].reshape(len(sigma_m), -1)
    size = plant["response"].shape[1::-1]  # as cacao has it, x first
    response = plant["response"].reshape(size[0] * size[1], -1)
    noise, hz = float(plant["noise"]), float(plant["hz"])
    n_slopes, n_modes, rows = len(response), len(modes), len(plant["matrix"])
    modes_wfs = path_of(folder, "aol1_modesWFS")
    Milk(modes_wfs, (*size, rows)).put(plant["matrix"] / UNIT)
    for name, value in (("aol1_mgain", GAIN), ("aol1_mmult", MULT)):
        Milk(path_of(folder, name), (rows, 1)).put(np.full(rows, value))
    channel = Milk(path_of(folder, "dm01disp05"), grid[::-1])
    slopes = Milk(path_of(folder, "aol1_imWFS2"), size, n_ring=RING, pid=1000)
    values = Milk(path_of(folder, "aol1_modevalWFS"), (rows, 1), n_ring=RING, pid=2000)
    mirror = Milk(path_of(folder, "aol1_modevalDM"), (rows, 1), n_ring=RING, pid=3000)
    copied, inode = values_in(modes_wfs).reshape(rows, n_slopes), modes_wfs.stat().st_ino
    rng, turbulence = np.random.default_rng(1), np.zeros(n_modes)
    answer, on_way = np.zeros(rows, np.float32), [np.zeros(modes.shape[1])] * 2
    start_s, k = time.monotonic(), 0
    sys.stdout.write("runs\n")
    sys.stdout.flush()
    while True:
        on_way[1] = on_way[1] + UNIT * channel.data[0]
        turbulence = 0.998 * turbulence + 0.063 * sigma_m * rng.standard_normal(n_modes)
        seen = response @ (on_way[0] + turbulence @ modes) + noise * rng.standard_normal(n_slopes)
        slopes.put(seen)
        values.put(copied @ seen, slopes)
        answer = np.float32(MULT) * answer - np.float32(GAIN) * values.data[0]
        mirror.put(answer, values, slopes)
        on_way = [on_way[1], UNIT * answer @ modes[:rows]]
        k += 1
        if k % 25 == 0 and modes_wfs.stat().st_ino != inode:
            copied, inode = values_in(modes_wfs).reshape(rows, n_slopes), modes_wfs.stat().st_ino
            values.pid += 1
        late_s = start_s + k / hz - time.monotonic()
        if late_s > 0:
            time.sleep(late_s)


if __name__ == "__main__":
    main(Path(sys.argv[1]), np.load(sys.argv[2]))
