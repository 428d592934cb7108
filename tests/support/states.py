"""States of the tracker by the names of their parts, whatever record each part is in."""

from dataclasses import fields, replace

from service.records.state import TrackerState

RECORDS = [field.name for field in fields(TrackerState) if field.name not in {"system", "log"}]
_BLANK = TrackerState(system="")
RECORD_OF = {part.name: record for record in RECORDS for part in fields(getattr(_BLANK, record))}


def changed(state, **parts):
    """Return the state with these parts; ``system`` and ``log`` are of the state itself."""
    by_record = {}
    for name, value in parts.items():
        by_record.setdefault(RECORD_OF.get(name), {})[name] = value
    own = by_record.pop(None, {})
    nested = {name: replace(getattr(state, name), **new) for name, new in by_record.items()}
    return replace(state, **own, **nested)


def tracker_state(system="flao", **parts):
    """Return a state with these parts, all others as at the start."""
    return changed(TrackerState(system=system), **parts)
