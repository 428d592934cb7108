"""Who may do what on the link: its three roles, as one table and as zenoh's access control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from service.wire.keys import Keys, Role

BESIDE: Final = "/@adv/**"
"""Behind a key: what zenoh's advanced publishers and subscribers say to each other."""


class LinkRole(StrEnum):
    """What a program is on the link."""

    RTC = "rtc"
    SERVICE = "service"
    VIEWER = "viewer"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rights:
    """Keys on which a role may act; what is in none of these is refused."""

    puts: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    queries: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    holds: tuple[str, ...] = ()
    """Liveliness tokens."""

    watches: tuple[str, ...] = ()
    """Liveliness tokens of others."""


def rights_of(keys: Keys) -> Mapping[LinkRole, Rights]:
    """Return what each role may do, and on which keys of a system."""
    frames_beside, all_commands = keys.frames + BESIDE, keys.command("*")
    frames, public = (keys.frames, frames_beside), (keys.state, keys.alarm)
    # what a cache replies with has the key of the message itself
    history = (*public, *(key + BESIDE for key in public))
    matrices = (keys.all_chunks, keys.all_commits)
    return {
        LinkRole.RTC: Rights(
            puts=(
                *frames,
                keys.status,
                keys.acknowledgement,
                keys.all_measured,
            ),
            subscribes=(*matrices, *public),
            queries=(keys.all_matrices, *history),
            answers=(all_commands, keys.applied, *frames),
            holds=(keys.alive(Role.RTC), frames_beside),
            watches=(keys.alive(Role.SERVICE),),
        ),
        LinkRole.SERVICE: Rights(
            puts=(*matrices, *history),
            subscribes=(
                *frames,
                keys.status,
                keys.acknowledgement,
                keys.all_measured,
                *public,
            ),
            queries=(all_commands, keys.applied, *frames),
            answers=(keys.all_matrices, *history),
            holds=(keys.alive(Role.SERVICE), keys.all_ranks),
            watches=(
                *(keys.alive(Role.RTC), keys.alive(Role.SERVICE), keys.all_ranks),
                frames_beside,
            ),
        ),
        LinkRole.VIEWER: Rights(
            subscribes=(keys.status, *matrices, *public),
            queries=history,
        ),
    }


INWARDS, OUTWARDS = "ingress", "egress"
"""Seen from the router: what a program sends, and what it is sent."""

_MESSAGES: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "puts": {INWARDS: ("put",), OUTWARDS: ("declare_subscriber",)},
    "subscribes": {INWARDS: ("declare_subscriber",), OUTWARDS: ("put",)},
    "queries": {INWARDS: ("query",), OUTWARDS: ("reply", "declare_queryable")},
    "answers": {INWARDS: ("reply", "declare_queryable"), OUTWARDS: ("query",)},
    "holds": {
        INWARDS: ("liveliness_token",),
        OUTWARDS: ("declare_liveliness_subscriber", "liveliness_query"),
    },
    "watches": {
        INWARDS: ("declare_liveliness_subscriber", "liveliness_query"),
        OUTWARDS: ("liveliness_token",),
    },
}
"""zenoh's messages by right and direction. Nobody may delete."""


def access_control(
    keys: Keys, names: Mapping[LinkRole, Sequence[str]], *, named_by: str
) -> dict[str, object]:
    """Return zenoh's ``access_control``: all that :func:`rights_of` does not allow is refused.

    Parameters
    ----------
    keys
        Of the system; no other system's may be used.
    names
        Of the programs that have a role.
    named_by
        What tells a program's name: ``cert_common_names`` or ``usernames``.
    """
    rules = [
        {
            "id": f"{role}-{right}-{flow}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": list(getattr(rights, right)),
        }
        for role, rights in rights_of(keys).items()
        for right, flows in _MESSAGES.items()
        for flow, messages in flows.items()
        if names[role] and getattr(rights, right)
    ]
    roles = [role for role in LinkRole if names[role]]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": str(role), named_by: list(names[role])} for role in roles],
        "policies": [
            {
                "rules": [str(rule["id"]) for rule in rules if str(rule["id"]).startswith(role)],
                "subjects": [str(role)],
            }
            for role in roles
        ],
    }
