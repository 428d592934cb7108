"""Files of other codes and of benches, with which the tutorials are followed.

``data`` has files that OOPAO, SPECULA, SynIM and pyRTC wrote of small simulations;
``python -m pyrcal.samples NAME FOLDER`` copies or makes those of one tutorial.
"""
