import pyrcal

matrix = pyrcal.interaction_matrix("canary")
reconstructor = pyrcal.reconstruct(
    matrix, pyrcal.InversionOptions(n_modes=20)
).matrix
bundle = pyrcal.Bundle(
    id="cm-1",
    arrays={"reconstructor": reconstructor},
    facts={"instrument": "canary"},
)
pyrcal.write_bundle("tonight.h5", bundle)
print("tonight.h5 has its checksums inside; .fits is possible, too")
