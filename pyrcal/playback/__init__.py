"""Recorded telemetry through the estimators of the service, without RTC, link or service."""
