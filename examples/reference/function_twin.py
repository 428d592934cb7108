import pyrcal
from pyrcal.samples.__main__ import main

main(["oopao", "bench"])
made = pyrcal.twin("bench", "twin")
print(made.report.fit.recommendation)
print(made.report.fit.alpha.to_boundary())
print(sorted(path.name for path in made.folder.iterdir()))
