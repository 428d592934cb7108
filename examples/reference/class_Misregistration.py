import numpy as np

import pyrcal

alpha = pyrcal.Misregistration(
    shift_x_subap=0.1,
    shift_y_subap=-0.05,
    rotation_rad=np.deg2rad(0.3),
    magnification=1.002,
)
print(alpha.rotation_deg, alpha.to_boundary())
same = pyrcal.Misregistration.from_boundary(alpha.to_boundary())
print(np.allclose(alpha.vector, same.vector))  # True
