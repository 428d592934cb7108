"""What the service knows and what happens to it, as frozen records.

Nothing is decided or computed here: records import numpy, the wire format and the misregistration
only, so that every part of the service may name the state without the numerics behind it.
"""
