"""From registration to reconstructor: inversion, stability, gate. Pure numerics."""
