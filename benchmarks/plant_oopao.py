"""The frame of ``benchmarks.plant`` in OOPAO; prints its milliseconds as the last line.

Run by an interpreter that has OOPAO and nothing of pyrcal: ``python plant_oopao.py 4``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable

import numpy as np

N_FRAMES = 10
N_MODULATION = 24


def processor_ms(function: Callable[[], object]) -> float:
    """Return the processor time of a call, milliseconds."""
    function()
    start_s = time.process_time()
    for _ in range(N_FRAMES):
        function()
    return (time.process_time() - start_s) / N_FRAMES * 1e3


def main() -> None:
    """Build telescope, layer, mirror and pyramid; time the frame."""
    from OOPAO.Atmosphere import Atmosphere
    from OOPAO.DeformableMirror import DeformableMirror
    from OOPAO.Pyramid import Pyramid
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope

    sampling = int(sys.argv[1])
    telescope = Telescope(
        resolution=30 * sampling,
        diameter=8.22,
        samplingTime=1e-3,
        centralObstruction=0.11,
        display_optical_path=False,
    )
    star = Source(optBand="I", magnitude=8)
    star * telescope
    sky = Atmosphere(
        telescope=telescope,
        r0=0.1,
        L0=25,
        windSpeed=[12],
        fractionalR0=[1],
        windDirection=[35],
        altitude=[0],
    )
    sky.initializeAtmosphere(telescope=telescope)
    mirror = DeformableMirror(telescope=telescope, nSubap=28, mechCoupling=0.35)
    sensor = Pyramid(
        nSubap=30,
        telescope=telescope,
        modulation=3,
        lightRatio=0.5,
        n_pix_separation=6,
        nTheta_user_defined=N_MODULATION,
    )
    sensor.cam.photonNoise = True
    sensor.cam.readoutNoise = 4
    rng = np.random.default_rng(1)
    control = rng.standard_normal((mirror.nValidAct, len(sensor.signal))).astype(np.float32)

    def step() -> None:
        sky.update()
        star**sky * telescope * mirror * sensor
        mirror.coefs = 1e-12 * (control @ sensor.signal)

    print(json.dumps(processor_ms(step)))


if __name__ == "__main__":
    main()
