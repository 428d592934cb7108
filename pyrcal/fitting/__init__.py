"""Files in, answers out: fits, reconstructors, exports, without a service."""
