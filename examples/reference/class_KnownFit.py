import subprocess
import sys

import h5py

import pyrcal

with h5py.File("measured.h5", "w") as file:
    file["interaction_matrix"] = pyrcal.interaction_matrix("canary")[
        :, :20
    ]
words = ["fit", "canary", "measured.h5", "--output", "fit.h5"]
subprocess.run([sys.executable, "-m", "pyrcal", *words], check=True)
known = pyrcal.read_fit("fit.h5")
print(known.alpha, known.modes, known.gains)
matrix = pyrcal.interaction_matrix(
    "canary", known.alpha
)  # of all modes, without noise
