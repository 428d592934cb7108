import pyrcal

basis = pyrcal.modal_basis(pyrcal.load_instrument("canary"))
print(
    basis.n_modes, basis.mode_to_actuator.shape
)  # 40 modes, each with a stroke of every actuator
