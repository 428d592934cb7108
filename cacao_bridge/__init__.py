"""The bridge from cacao's streams in shared memory to pyrcal's contract."""
