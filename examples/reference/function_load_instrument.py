import pyrcal

instrument = pyrcal.load_instrument(
    "flao-lbt"
)  # a packaged name, or the path of a TOML file
print(
    instrument.diameter_m,
    instrument.wfs.n_subapertures,
    instrument.modes.n_modes,
)  # 8.222 30 594
