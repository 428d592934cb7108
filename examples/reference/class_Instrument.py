import pyrcal

instrument = pyrcal.load_instrument("canary")
print(instrument.name, instrument.diameter_m, instrument.stop)
print(instrument.wfs.n_subapertures, instrument.modes.n_modes)
print(
    instrument.remarks
)  # what the file does not say, and what is taken instead
