import pyrcal

try:
    pyrcal.load_instrument("no-such-telescope")
except (
    pyrcal.ConfigurationError
) as error:  # a file or a setting that cannot be used
    print(error)
