"""From registration to reconstructor: dither design, inversion, stability, gate; numerics only."""
