"""Parts of the link that ``service.rtc_bridge`` assembles.

``session`` is the only module that calls zenoh; the others can be tested without a network. The
callbacks of zenoh's threads end in :class:`~service.link.intake.Intake`, which holds a lock for
microseconds. Readers (``drain``, ``events``, ``statistics``) use the same lock.
"""
