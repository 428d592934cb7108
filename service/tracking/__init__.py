"""The functions that ``step`` is made of. A reader begins with ``service.tracker``.

Each changes only the fields of the state that it owns; ``service.records`` has the state. Only the
reactions of the tracker's tables are given an event, and no other package calls what takes a
``StepContext``. Others read: permissions (``interlocks``), what runs (``operations.running``), what
outlives a restart (``resume``), policy, limits and functions of ``TrackerState`` alone.
"""
