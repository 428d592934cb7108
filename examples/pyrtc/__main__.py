"""Calibrate a loop of pyRTC on a simulated telescope of OOPAO with pyrcal."""

import argparse
import json
from pathlib import Path

import numpy as np

from service.config.link_tables import router_of

from .bench import GAIN, Bench
from .bridge import Bridge

N_SETTLING_FRAMES = 100
"""Number of frames after which a loop has converged."""


def residual_nm(bench, matrix, gain, seed, n_frames):
    """Return the residual wavefront of a loop with a matrix, nm RMS over pupil and time."""
    bench.use(matrix, gain)
    bench.begin(seed)
    squares = []
    for _ in range(n_frames):
        bench.frame(np.zeros(bench.n_modes))
        squares.append(bench.residual_m**2)
    return round(1e9 * float(np.sqrt(np.mean(squares[N_SETTLING_FRAMES:]))), 2)


def main():
    parser = argparse.ArgumentParser(prog="python -m examples.pyrtc", description=__doc__)
    parser.add_argument(
        "folder",
        type=Path,
        help="folder for oopao.toml, on which to start the service; a bundle.h5 in it is applied",
    )
    parser.add_argument("--connect", help="endpoint of the service, default tcp/127.0.0.1:7447")
    parser.add_argument("--config", type=Path, help="settings of a secured link, rtc.toml")
    parser.add_argument("--shift", type=float, nargs=2, default=(0.3, 0.0), metavar="SUBAP")
    parser.add_argument("--rotation", type=float, default=1.0, metavar="DEG")
    parser.add_argument("--modes", type=int, default=80, help="number of controlled modes")
    parser.add_argument("--seed", type=int, default=1, help="seed of turbulence and noise")
    parser.add_argument(
        "--frames", type=int, default=4500, help="number of frames with the service connected"
    )
    parser.add_argument(
        "--compare", type=int, default=0, help="number of frames with each of three matrices"
    )
    parser.add_argument(
        "--gains", type=float, nargs="*", default=(GAIN,), help="loop gains of the comparison"
    )
    options = parser.parse_args()

    options.folder.mkdir(parents=True, exist_ok=True)
    bench = Bench(options.shift, options.rotation)
    try:
        print("instrument", bench.write_instrument(options.folder), flush=True)
        nominal, true = (
            np.linalg.pinv(bench.measure_with_oopao(mirror)[:, : options.modes]).astype(np.float32)
            for mirror in (bench.aligned, bench.mirror)
        )
        bench.begin(options.seed)
        bridge = Bridge(bench, "oopao", nominal)
        bridge.run(router_of(options.config, options.connect), options.frames, options.folder)
        used = bridge.reconstructor
        found = {"id": used.manifest.id, "alpha": used.manifest.alpha, "sigma": used.manifest.sigma}
        if options.compare:
            three = {"nominal": nominal, "oopao": true, "pyrcal": used.matrix}
            sky = options.seed, options.compare
            found["residual_nm"] = {
                gain: {of: residual_nm(bench, matrix, gain, *sky) for of, matrix in three.items()}
                for gain in options.gains
            }
        print(json.dumps(found), flush=True)
    finally:
        bench.close()


main()
