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


def run(frames):
    """Publish batches of frames until the link is lost."""
    connection = rtc.RtcConnection(
        computer,
        rtc.Router(endpoint="tcp/127.0.0.1:7447"),
        batches_per_s=50.0,
    )
    with connection.open() as link:
        while not link.is_lost():
            dither_m = computer.begin_batch(10)
            link.publish_frames(
                *computer.end_batch(*frames(dither_m), dither_m)
            )
            link.publish_status(computer.status())
