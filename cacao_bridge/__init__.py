"""The bridge to cacao: its streams in shared memory on one side, pyrcal's contract on the other."""
