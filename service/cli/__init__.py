"""The service's own commands: ``run`` and ``key``."""
