"""The simulated real-time computer of an adaptive telescope: its own process, its own truth.

It shares the optics primitives, the instrument file and the wire format with the service, and
nothing else; its plant differs from the service's model on purpose.
"""
