import pyrcal
from pyrcal.samples.__main__ import main

main(["synim", "."])
files = ["synim-im.fits", "synim-subap.fits", "synim-ifunc.fits"]
imported = pyrcal.from_synim(files, pyrcal.Reported(diameter_m=8.0))
print(imported.save("bench").instrument)
