"""The REST routes by idea: what the service knows, what an operator asks of it, how it is doing."""
