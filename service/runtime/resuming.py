"""What a service leaves on the disk of its tracking, and how the next one takes it up."""

from __future__ import annotations

from service.archive import Archive
from service.errors import ArchiveError
from service.reactions.journal import logged
from service.reactions.orders import orders_of
from service.reactions.policy import Policy
from service.reactions.restoring import resumed, saved_of, with_orders
from service.state import Level, TrackerState

SAVE_INTERVAL_S = 5.0
"""Least time between two writes; an α that old is as good as a new one."""


def taken_up(archive: Archive, state: TrackerState, policy: Policy, now_ns: int) -> TrackerState:
    """Return the state with the registration that was saved, if there is one and it fits.

    A damaged file costs the α in it and nothing else. What else is wrong in the archive is told.
    """
    for text in archive.wrong:
        state = logged(state, "archive.damaged", text, now_ns, Level.WARNING)
    try:
        saved = archive.tracking.read()
    except ArchiveError as error:
        return logged(state, "registration.not-restored", str(error), now_ns, Level.WARNING)
    return state if saved is None else resumed(state, saved, policy, now_ns)


def leave(archive: Archive, state: TrackerState, now_ns: int) -> None:
    """Save what the next service needs; blocks until it is on the disk.

    Raises
    ------
    ArchiveError
        If the disk refuses, or what is there is damaged; it has been put aside then.
    """
    saved = saved_of(state, now_ns)
    if saved is None or not saved.tells_of_alpha:
        left = archive.tracking.read()
        if left is not None and left.system == state.system:
            saved = with_orders(left, state)
    if saved is not None:
        archive.tracking.write(saved)


def has_news(before: TrackerState, after: TrackerState) -> bool:
    """Return whether something has been measured, or begun, that is not saved yet."""
    if is_urgent(before, after):
        return True
    old, new = before.registration, after.registration
    if old is None or new is None:
        return new is not None
    return (old.t_ns_utc, old.doubt) != (new.t_ns_utc, new.doubt)


def is_urgent(before: TrackerState, after: TrackerState) -> bool:
    """Return whether what is not saved yet cannot wait: whose the RTC's open loop is, and orders.

    A service killed a second later would leave its own loop open to one that cannot know, or one
    that undoes what an operator has ordered.
    """
    return orders_of(before) != orders_of(after) or _course(before) != _course(after)


def _course(state: TrackerState) -> tuple[object, ...]:
    acquisition, rtc = state.acquisition, state.rtc
    if not acquisition.under_way:
        return (acquisition.stage,)
    session = None if rtc is None else rtc.session
    return acquisition.stage, acquisition.attempt, acquisition.matrix, session
