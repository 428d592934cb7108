"""OOPAO's telescope in pyRTC's loop, calibrated by pyrcal; ``python -m examples.pyrtc --help``."""

import argparse
import json
from pathlib import Path

import numpy as np

from service.config.link_tables import router_of

from .bench import GAIN, Bench
from .bridge import Bridge

SETTLED = 100
"""Frames after which a loop has closed."""


def residual_nm(bench, matrix, gain, seed, n_frames):
    """Return the RMS over pupil and time that a matrix leaves of the sky of that seed."""
    bench.use(matrix, gain)
    bench.begin(seed)
    squares = []
    for _ in range(n_frames):
        bench.frame(np.zeros(bench.n_modes))
        squares.append(bench.residual_m**2)
    return round(1e9 * float(np.sqrt(np.mean(squares[SETTLED:]))), 2)


def main():
    parser = argparse.ArgumentParser(prog="python -m examples.pyrtc", description=__doc__)
    parser.add_argument(
        "folder",
        type=Path,
        help="where oopao.toml is written; start the service on it; bundle.h5 there is applied",
    )
    parser.add_argument("--connect", help="its endpoint, default tcp/127.0.0.1:7447")
    parser.add_argument("--config", type=Path, help="settings of a secured link: rtc.toml")
    parser.add_argument("--shift", type=float, nargs=2, default=(0.3, 0.0), metavar="SUBAP")
    parser.add_argument("--rotation", type=float, default=1.0, metavar="DEG")
    parser.add_argument("--modes", type=int, default=80, help="that the loop controls")
    parser.add_argument("--seed", type=int, default=1, help="of sky and noise")
    parser.add_argument(
        "--frames", type=int, default=4500, help="to be calibrated for, then it ends"
    )
    parser.add_argument(
        "--compare", type=int, default=0, help="frames under each of three matrices"
    )
    parser.add_argument("--gains", type=float, nargs="*", default=(GAIN,), help="of the loop then")
    asked = parser.parse_args()

    asked.folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(asked.shift, asked.rotation)
    try:
        print("instrument", bench.write_instrument(asked.folder), flush=True)
        nominal, true = (
            np.linalg.pinv(bench.measured_by_oopao(mirror)[:, : asked.modes]).astype(np.float32)
            for mirror in (bench.aligned, bench.mirror)
        )
        bench.begin(asked.seed)
        bridge = Bridge(bench, "oopao", nominal)
        bridge.run(router_of(asked.config, asked.connect), asked.frames, asked.folder)
        used = bridge.reconstructor
        found = {"id": used.manifest.id, "alpha": used.manifest.alpha, "sigma": used.manifest.sigma}
        if asked.compare:
            three = {"nominal": nominal, "oopao": true, "pyrcal": used.matrix}
            sky = asked.seed, asked.compare
            found["residual_nm"] = {
                gain: {of: residual_nm(bench, matrix, gain, *sky) for of, matrix in three.items()}
                for gain in asked.gains
            }
        print(json.dumps(found), flush=True)
    finally:
        bench.close()


main()
