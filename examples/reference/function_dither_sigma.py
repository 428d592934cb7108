import numpy as np

import pyrcal

instrument = pyrcal.load_instrument("canary")
model = pyrcal.RtcInteractionModel(
    instrument, pyrcal.modal_basis(instrument)
)
near = model.linearise(pyrcal.Misregistration())
sigma = pyrcal.dither_sigma(
    near, [25, 30, 35], amplitude_m=10e-9, n_frames=2000, slope_noise=0.05
)
print(
    np.rad2deg(sigma[2]), "deg, 1 sigma of the rotation after 2000 frames"
)
