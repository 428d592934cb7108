"""Commands that ask a running service over REST."""
