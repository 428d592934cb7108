"""The functions that ``step`` is made of. A reader begins with ``service.tracker``.

Each changes only the fields of the state that it owns; ``service.records`` has the state.
"""
