import pyrcal


def fit_or_explain(instrument, path):
    """Fit a matrix of a file."""
    try:
        return pyrcal.fit_file(instrument, path, pyrcal.FitOptions())
    except (
        pyrcal.StorageError
    ) as error:  # an archive or a file that cannot be read or written
        print(error)
    return None
