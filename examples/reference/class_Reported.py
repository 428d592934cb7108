import pyrcal
from pyrcal.samples.__main__ import main

main(["specula", "."])
files = ["specula-im.fits", "specula-pup.fits", "specula-ifunc.fits"]
reported = pyrcal.Reported(diameter_m=8.0, wavelength_m=750e-9)
imported = pyrcal.from_specula(files, reported)
print(imported.tables["wfs"]["wavelength_m"])
