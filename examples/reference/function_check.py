import pyrcal

instrument = pyrcal.load_instrument("canary")
for one in pyrcal.conventions.check(
    instrument, pyrcal.interaction_matrix(instrument)
):
    print(one.rule, one.kept, one.text)
