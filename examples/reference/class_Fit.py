import numpy as np

import pyrcal

truth = pyrcal.Misregistration(shift_x_subap=0.1, rotation_rad=0.004)
measured = pyrcal.interaction_matrix("canary", truth)[:, :20]
found = pyrcal.fit("canary", measured, modes=np.arange(20))
print(found.accepted, found.recommendation)
print(found.alpha.shift_x_subap, found.alpha.rotation_deg)
print(found.gains[:3], found.residual_fraction)
print(found.sigma_to_boundary()["rotation_deg"])
