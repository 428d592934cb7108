import pyrcal

try:
    pyrcal.load_instrument("no-such-telescope")
except pyrcal.PyrcalError as error:  # anything of pyrcal's own
    print(error)
