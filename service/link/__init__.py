"""Parts of the link that ``service.rtc_bridge`` assembles.

``session`` is the only module that calls zenoh; the others can be tested without a network. The
callbacks of zenoh's threads end in :class:`~service.link.intake.Intake`, which holds a lock for
microseconds. Readers use the same lock. One of them, the consumer, calls ``drain`` and ``events``,
because each frame and event is returned once; anybody may read ``statistics`` and
``other_session``. Frames are copies, all else is immutable. The other methods are for the
callbacks, and ``expect`` and ``set_wakeup`` for the owner.
"""
