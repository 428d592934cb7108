"""The service's own commands: ``run`` and ``key``, and how a program of pyrcal ends."""
