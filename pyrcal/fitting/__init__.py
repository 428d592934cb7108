"""Fits of measured matrices, and reconstructors, from files; no service is needed."""
