"""Commands that work on files and need no running service."""
