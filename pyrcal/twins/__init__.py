"""Models of a fitted bench that other programs run."""
