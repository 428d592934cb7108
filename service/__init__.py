"""pyrcal: the calibration service of an adaptive telescope with a pyramid sensor."""

__version__ = "0.1.0"
