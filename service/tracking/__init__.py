"""What the service knows, what happens to it, and what it makes of it: the parts of ``step``."""
