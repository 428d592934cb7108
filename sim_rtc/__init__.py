"""The simulated RTC of an adaptive telescope, a process of its own.

It shares the optics primitives, the instrument file and the wire format with the service, and
nothing else; its plant differs from the service's model on purpose.
"""
