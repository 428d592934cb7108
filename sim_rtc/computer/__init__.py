"""The real-time computer: loop, operations on request, telemetry."""
