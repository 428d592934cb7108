"""The real-time computer: the loop, what is done with it on request, and its telemetry."""
