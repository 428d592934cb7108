import numpy as np

import pyrcal

instrument = pyrcal.load_instrument("canary")
basis, matrix = (
    pyrcal.modal_basis(instrument),
    pyrcal.interaction_matrix(instrument),
)
prior = pyrcal.Prior(
    variance_m2=basis.variance_m2,  # of each mode in turbulence
    slope_noise=np.full(len(matrix), 0.05),  # 1 sigma of each slope
)
print(
    pyrcal.reconstruct(
        matrix, pyrcal.InversionOptions(n_modes=40, prior=prior)
    ).matrix.shape
)
