"""``pyrcal instrument``: write, check and draw an instrument file."""
