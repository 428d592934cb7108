"""Parts of the link that ``service.rtc_bridge`` puts together.

``session`` is the only module that calls zenoh; the rest can be tried without a network. The
callbacks of zenoh's threads end in :class:`~service.link.intake.Intake`, which takes a lock for
microseconds; whoever reads (``drain``, ``events``, ``statistics``) takes the same lock.
"""
