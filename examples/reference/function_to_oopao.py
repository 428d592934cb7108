from types import SimpleNamespace

import pyrcal

tel = SimpleNamespace(D=8.0, resolution=80)  # your Telescope and sensor
wfs = SimpleNamespace(nSubap=20)
alpha = pyrcal.Misregistration(shift_x_subap=0.1)
print(
    pyrcal.to_oopao(alpha, tel, wfs)
)  # what MisRegistration of OOPAO takes
