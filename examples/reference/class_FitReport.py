import h5py

import pyrcal

with h5py.File("measured.h5", "w") as file:
    file["interaction_matrix"] = pyrcal.interaction_matrix("canary")[
        :, :20
    ]
report = pyrcal.fit_file(
    pyrcal.load_instrument("canary"),
    "measured.h5",
    pyrcal.FitOptions(explain=True),
)
print(report.instrument, report.reference, report.reference_sha256[:8])
print(round(report.fit.residual_fraction, 3), round(report.seconds, 1))
