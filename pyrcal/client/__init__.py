"""A running service, asked over REST: the commands that look at it and give it orders."""
