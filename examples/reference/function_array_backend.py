import pyrcal

arrays = pyrcal.array_backend(
    "numpy"
)  # "torch" and "cupy" need their packages
instrument = pyrcal.load_instrument("canary")
model = pyrcal.RtcInteractionModel(
    instrument, pyrcal.modal_basis(instrument), arrays=arrays
)
print(model.interaction_matrix(pyrcal.Misregistration()).shape)
