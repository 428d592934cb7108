from pathlib import Path

import h5py

import pyrcal

Path("system.toml").write_text(
    '[system]\nname = "one"\ninstrument = "canary"\n'
    '[[sensors]]\nname = "wfs"\n[[mirrors]]\nname = "dm"\n'
)
with h5py.File("measured.h5", "w") as file:
    file["wfs/dm/interaction_matrix"] = pyrcal.interaction_matrix(
        "canary"
    )
report = pyrcal.fit_system("system.toml", "measured.h5")
print(report.accepted, report.found.values)
