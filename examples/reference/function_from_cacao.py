import pyrcal
from pyrcal.samples.__main__ import main

main(["cacao", "conf"])
imported = pyrcal.from_cacao("conf", pyrcal.Reported(diameter_m=2.0))
print(imported.save("bench").instrument)
