from pathlib import Path

import pyrcal

alpha = pyrcal.Misregistration(shift_x_subap=0.1)
exported = pyrcal.to_specula("flao-lbt", Path("model"), alpha)
print(exported.path)  # specula --cpu --precision 0 specula_model.yml
print(exported.remarks)
