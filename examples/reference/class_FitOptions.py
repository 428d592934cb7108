import numpy as np

import pyrcal

measured = pyrcal.interaction_matrix(
    "canary", pyrcal.Misregistration(shift_x_subap=0.3)
)[:, :20]
options = pyrcal.FitOptions(
    start=pyrcal.Misregistration(shift_x_subap=0.25),  # near the truth
    anamorphosis=False,  # the image of the mirror is not stretched
)
found = pyrcal.fit(
    "canary", measured, modes=np.arange(20), options=options
)
print(round(found.alpha.shift_x_subap, 3))  # 0.3
