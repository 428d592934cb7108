import pyrcal

instrument = pyrcal.load_instrument("canary")
model = pyrcal.RtcInteractionModel(
    instrument, pyrcal.modal_basis(instrument)
)
alpha = pyrcal.Misregistration(shift_x_subap=0.1)
matrix = model.interaction_matrix(alpha)
near = model.linearise(
    alpha
)  # D and its derivatives by the four parameters
print(matrix.shape, near.derivatives.shape)
