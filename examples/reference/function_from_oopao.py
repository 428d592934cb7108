import pyrcal


def fit_simulation(tel, ngs, dm, wfs, calib, modes):
    """Fit the interaction matrix of your simulation."""
    saved = pyrcal.from_oopao(tel, dm, wfs, calib, modes, ngs).save(
        "bench"
    )
    instrument = pyrcal.load_instrument(saved.instrument)
    return pyrcal.fit_file(
        instrument, saved.matrix, pyrcal.FitOptions(explain=True)
    )
