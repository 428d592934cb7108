from pyrcal import rtc

request = rtc.DitherRequest(
    id="dither-1",
    kind="sine",
    modes=(8, 15),
    amplitude_m=(10e-9, 10e-9),
    frequency_hz=(87.0, 101.0),
    duration_s=4.0,
)
dither = rtc.Dither(
    request, start_seq=1000, n_modes=40, frame_rate_hz=500.0
)
print(dither)
