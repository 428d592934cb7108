import pyrcal


def fit_or_explain(instrument, path):
    """Fit a matrix of a file."""
    try:
        return pyrcal.fit_file(instrument, path, pyrcal.FitOptions())
    except pyrcal.ModelError as error:  # a model that cannot be computed
        print(error)
    return None
