import numpy as np

import pyrcal

truth = pyrcal.Misregistration(shift_x_subap=0.05)
response = pyrcal.interaction_matrix("canary", truth)
matrix = pyrcal.reconstruct(
    pyrcal.interaction_matrix("canary"),
    pyrcal.InversionOptions(n_modes=20),
).matrix
rng, n_frames, rate_hz = np.random.default_rng(1), 6000, 500.0
lines_hz = {25: 43.5, 30: 50.5, 35: 56.5, 38: 65.5}  # by mode
dither_m = np.zeros((n_frames, 40))
for mode, line_hz in lines_hz.items():
    dither_m[:, mode] = 30e-9 * np.sin(
        2.0 * np.pi * line_hz * np.arange(n_frames) / rate_hz
    )
commands_m, slopes = (
    np.zeros((n_frames + 2, 40)),
    np.zeros((n_frames, len(response))),
)
for k in range(n_frames):  # an integrator with a delay of two frames
    commands_m[k] += dither_m[k]
    slopes[k] = response @ commands_m[k] + 0.02 * rng.normal(
        size=len(response)
    )
    commands_m[k + 2, :20] = (
        commands_m[k + 1, :20] - 0.3 * matrix @ slopes[k]
    )
np.savez(
    "telemetry.npz",
    slopes=slopes,
    commands_m=commands_m[:n_frames],
    dither_m=dither_m,
    dither_modes=list(lines_hz),
    dither_frequencies_hz=list(lines_hz.values()),
    dither_amplitude_m=np.full(4, 30e-9 / np.sqrt(2.0)),
    gains=np.where(np.arange(40) < 20, 0.3, 0.0),
    reconstructor=matrix,
    frame_rate_hz=rate_hz,
)
track = pyrcal.track("telemetry.npz", "canary")
for alpha, sigma in zip(track.alpha, track.sigma, strict=True):
    print(np.round(alpha, 3), np.round(sigma, 3))
print(track.n_frames, track.n_missing)
