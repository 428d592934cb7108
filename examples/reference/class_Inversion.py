import pyrcal

found = pyrcal.reconstruct(
    pyrcal.interaction_matrix("canary"),
    pyrcal.InversionOptions(n_modes=20),
)
print(found.matrix.shape, found.condition_number, found.n_truncated)
