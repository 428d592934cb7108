import pyrcal
from pyrcal.samples.__main__ import main

main(["specula", "."])
files = ["specula-im.fits", "specula-pup.fits", "specula-ifunc.fits"]
imported = pyrcal.from_specula(files, pyrcal.Reported(diameter_m=8.0))
saved = imported.save("bench")
print(saved.instrument, imported.arrays["interaction_matrix"].shape)
