"""From telemetry to registration. Pure numerics: no clock, log, file or thread."""
