import numpy as np

import pyrcal

truth = pyrcal.Misregistration(shift_x_subap=0.1, rotation_rad=0.004)
measured = pyrcal.interaction_matrix("canary", truth)[:, :20]
found = pyrcal.fit("canary", measured, modes=np.arange(20))
print(found.verdict)
for name, value in found.alpha.to_boundary().items():
    print(
        name,
        round(value, 4),
        "+-",
        round(found.sigma_to_boundary()[name], 4),
    )
