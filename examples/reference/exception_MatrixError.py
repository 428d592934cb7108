import pyrcal

try:
    pyrcal.fit("canary", [[1.0, 2.0]], modes=[0, 1, 2])
except pyrcal.MatrixError as error:  # a matrix that cannot be used
    print(error)
