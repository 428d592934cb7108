from pyrcal import rtc

request = rtc.DitherRequest(
    id="dither-1",
    kind="sine",
    modes=(8, 15),
    amplitude_m=(10e-9, 10e-9),
    frequency_hz=(87.0, 101.0),
    duration_s=4.0,
)
reason = rtc.check_dither(
    request,
    n_modes=40,
    frame_rate_hz=500.0,
    max_amplitude_m=5e-9,
    max_duration_s=60.0,
)
print(reason)  # empty if it may be played
