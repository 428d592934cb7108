"""Importers: an instrument file, modes and a matrix from what users of other codes have."""
