import pyrcal
from pyrcal.samples.__main__ import main

main(["oopao", "bench"])
made = pyrcal.twin("bench", "twin")
print(f"{made.residual:.1%} of the signal is left over")
instrument = pyrcal.load_instrument(made.folder)
