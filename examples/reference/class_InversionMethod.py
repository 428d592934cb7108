import pyrcal

print(
    [method.value for method in pyrcal.InversionMethod]
)  # of settings and command line
