"""Frozen records of all that the service knows and all that happens to it.

Nothing is decided or computed here: records import numpy, the wire format and the misregistration
only, so that every part of the service may name the state without the numerics behind it.
"""
