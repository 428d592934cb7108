"""The tracker: state, events, and the functions that ``step`` is made of."""
