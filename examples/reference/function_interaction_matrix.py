import pyrcal

alpha = pyrcal.Misregistration(shift_x_subap=0.1, rotation_rad=0.004)
matrix = pyrcal.interaction_matrix("canary", alpha)
print(
    matrix.shape
)  # (72, 40): slopes, modes; slope per metre of optical path
