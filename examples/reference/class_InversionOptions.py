import pyrcal

few = pyrcal.InversionOptions(n_modes=20)
careful = pyrcal.InversionOptions(
    n_modes=40, max_condition=20.0
)  # weak directions are left out
matrix = pyrcal.interaction_matrix("canary")
print(
    [
        pyrcal.reconstruct(matrix, one).n_truncated
        for one in (few, careful)
    ]
)
