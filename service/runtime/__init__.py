"""The running service: what is heard becomes events, what is decided becomes actions."""
