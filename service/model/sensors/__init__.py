"""Wavefront sensors: protocols that all of them keep, and a folder for each kind."""
