"""The link to the service."""
