"""pyrcal: the calibration service of an adaptive telescope."""

__version__ = "0.1.0"
