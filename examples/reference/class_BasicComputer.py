import numpy as np

from pyrcal import rtc

matrix = np.zeros(
    (20, 72), dtype=np.float32
)  # your reconstructor, metres per unit of slope
computer = rtc.BasicComputer(
    rtc.Identity(system="bench", basis_id="kl-1", config_id="mask-1"),
    matrix,
    gains=np.where(np.arange(40) < 20, 0.4, 0.0),
    leak=0.99,
    frame_rate_hz=500.0,
    delay_frames=2.0,
    max_dither_m=50e-9,
)
dither_m = computer.begin_batch(10)
slopes = np.zeros((10, 72), dtype=np.float32)  # from your sensor
header, rows = computer.end_batch(slopes, dither_m, dither_m)
print(header.n, rows.shape)
