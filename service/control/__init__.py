"""Registration to reconstructor: inversion, stability, gate. Pure numerics."""
