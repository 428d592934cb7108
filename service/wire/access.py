"""Permissions of the three roles on the link, as a table and as zenoh's access control.

The RTC, the service and read-only viewers each have a role. :func:`list_rights` is the table;
:func:`access_control` translates it into the configuration of zenoh's router, which then refuses
everything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from ipaddress import ip_address
from typing import Final

from service.wire.keys import Keys, Role

ADVANCED_SUFFIX: Final = "/@adv/**"
"""Suffix of the keys on which zenoh's advanced publishers and subscribers exchange messages."""


DAY_S: Final = 86400.0


class LinkRole(StrEnum):
    """Role of a program on the link."""

    RTC = "rtc"
    SERVICE = "service"
    VIEWER = "viewer"


@dataclass(frozen=True, slots=True, kw_only=True)
class Rights:
    """Key expressions on which a role may act; all others are refused."""

    puts: tuple[str, ...] = ()
    subscribes: tuple[str, ...] = ()
    queries: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    holds: tuple[str, ...] = ()
    """Liveliness tokens that the role may declare."""

    watches: tuple[str, ...] = ()
    """Liveliness tokens of other programs that the role may observe."""


def list_rights(keys: Keys) -> Mapping[LinkRole, Rights]:
    """Return the rights of each role on the keys of one system."""
    advanced_frames, all_commands = keys.frames + ADVANCED_SUFFIX, keys.command("*")
    frames = (keys.frames, advanced_frames)
    public = (keys.state, keys.alarm, keys.gains, keys.references)
    # A late subscriber fetches the last message from the publisher's cache, whose reply carries
    # the key of the message itself: publishers need the right to answer on that key as well.
    history = (*public, *(key + ADVANCED_SUFFIX for key in public))
    in_use = (keys.applied, keys.references_in_use)
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
            answers=(all_commands, *in_use, *frames),
            holds=(keys.alive(Role.RTC), advanced_frames),
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
            queries=(all_commands, *in_use, *frames),
            answers=(keys.all_matrices, *history),
            holds=(keys.alive(Role.SERVICE), keys.all_ranks),
            watches=(
                *(keys.alive(Role.RTC), keys.alive(Role.SERVICE), keys.all_ranks),
                advanced_frames,
            ),
        ),
        LinkRole.VIEWER: Rights(
            subscribes=(keys.status, *matrices, *public),
            queries=history,
        ),
    }


INGRESS, EGRESS = "ingress", "egress"
"""Directions as zenoh's router names them: from a program, and to a program."""

_MESSAGES_BY_RIGHT: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    # A publisher must learn of the subscribers, or zenoh sends nothing to them.
    "puts": {INGRESS: ("put",), EGRESS: ("declare_subscriber",)},
    "subscribes": {INGRESS: ("declare_subscriber",), EGRESS: ("put",)},
    "queries": {INGRESS: ("query",), EGRESS: ("reply", "declare_queryable")},
    "answers": {INGRESS: ("reply", "declare_queryable"), EGRESS: ("query",)},
    "holds": {
        INGRESS: ("liveliness_token",),
        EGRESS: ("declare_liveliness_subscriber", "liveliness_query"),
    },
    "watches": {
        INGRESS: ("declare_liveliness_subscriber", "liveliness_query"),
        EGRESS: ("liveliness_token",),
    },
}
"""Message types of zenoh that a right allows, by direction. No right allows ``delete``."""


def access_control(
    keys: Keys, names: Mapping[LinkRole, Sequence[str]], *, subject_kind: str
) -> dict[str, object]:
    """Return zenoh's ``access_control`` table, which allows only what :func:`list_rights` lists.

    Parameters
    ----------
    keys
        Keys of the system; the keys of any other system are refused.
    names
        Names of the programs that have each role; a role without names gets no rule.
    subject_kind
        How zenoh identifies a program: ``cert_common_names`` or ``usernames``.
    """
    rules = [
        {
            "id": f"{role}-{right}-{flow}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": list(getattr(rights, right)),
        }
        for role, rights in list_rights(keys).items()
        for right, flows in _MESSAGES_BY_RIGHT.items()
        for flow, messages in flows.items()
        if names[role] and getattr(rights, right)
    ]
    roles = [role for role in LinkRole if names[role]]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": str(role), subject_kind: list(names[role])} for role in roles],
        "policies": [
            {
                "rules": [str(rule["id"]) for rule in rules if str(rule["id"]).startswith(role)],
                "subjects": [str(role)],
            }
            for role in roles
        ],
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """A certificate that the link depends on."""

    path: str
    name: str
    """Its common name: what access goes by."""

    ends_s: float
    """Expiry, seconds since the Unix epoch, UTC."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSecurity:
    """Security of a link; by default there is none."""

    zenoh: Mapping[str, object] = field(default_factory=dict)
    """Configuration of zenoh for certificates, users and access."""

    roles: Mapping[str, str] = field(default_factory=dict)
    """The role of each name that has one; empty: no names are known."""

    certificates: tuple[Certificate, ...] = ()
    secret: bytes | None = None
    """Key that signs messages; None if messages are neither signed nor checked."""

    warn_s: float = 30 * DAY_S
    """Time before its expiry from which a certificate is reported, seconds."""


NO_SECURITY: Final = LinkSecurity()


def is_loopback(host: str) -> bool:
    """Return whether what listens there can be asked by this machine alone."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
