import numpy as np

import pyrcal

matrix = pyrcal.interaction_matrix("canary")
found = pyrcal.reconstruct(matrix, pyrcal.InversionOptions(n_modes=20))
print(
    found.matrix.shape,
    round(found.condition_number, 1),
    found.n_truncated,
)
print(
    np.allclose(found.matrix @ matrix[:, :20], np.eye(20), atol=1e-4)
)  # True
