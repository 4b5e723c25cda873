"""Who may say what on the bus: zenoh's access control for a router, made from roles and the list of members.

Everything is denied but what stands here. zenoh knows a member by the common name of its certificate, letter by letter,
so that what is a member's own (its state, its reports' notices, its sensors) needs a rule a member. An allowed key must
include the key of a message: a subscription to `gnd/v1/**` is included by none of them, and so denied.

"ingress" is what a router receives from a member, "egress" what it passes on to one. Egress rules go by role:
nothing is passed on that was not subscribed to or asked for, and that is checked on the way in.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from gnd.fleet_bus.identity.names import ROLES, MemberName

_V1: Final = "gnd/v1"
_MAP: Final = tuple(f"{_V1}/{kind}/**" for kind in ("tile", "tiles", "catalog"))
_UPDATES: Final = (f"{_V1}/update/**",)
_RECALL: Final = (f"{_V1}/update/**/@adv/**",)
"""Where zenoh's advanced publishers and subscribers agree on what was missed."""
_CHANGES: Final = (f"{_V1}/change/**",)
_STATES: Final = (f"{_V1}/state/*",)
_WANTS: Final = (f"{_V1}/want/*",)
_TRAFFIC: Final = (f"{_V1}/traffic/*",)
_HEALTH: Final = (f"{_V1}/health/*",)
_SHARDS_ALIVE: Final = (f"{_V1}/alive/merger/*",)
_ALIVE: Final = (f"{_V1}/alive/**",)
_CERTIFICATES: Final = (f"{_V1}/certificate/*",)
"""Certificates that seals name; they prove themselves."""
AUTHORITY_KEYS: Final = f"{_V1}/authority/*"
"""Where the lists of an authority are put: members, revoked. They are signed."""
REVOKED_KEY: Final = f"{_V1}/authority/revoked"
_EVERYTHING: Final = ("**", "**/@adv/**")
_ALL: Final = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
)
_OWN_SENSORS: Final = ("put", "declare_subscriber", "query", "declare_queryable", "reply")


@dataclass(frozen=True, slots=True)
class Right:
    """What is allowed: messages on keys, towards the router ("ingress"), from it ("egress"), or both.

    Attributes:
        messages: zenoh's names of messages.
        keys: key expressions that include what is allowed.
        flows: directions.
    """

    messages: tuple[str, ...]
    keys: tuple[str, ...]
    flows: tuple[str, ...]

    def rule(self, name: str) -> dict[str, Any]:
        """As zenoh takes it."""
        flows, messages = list(self.flows), list(self.messages)
        return {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": list(self.keys)}


def _puts(*keys: str) -> tuple[Right, ...]:
    # Who publishes hears of subscribers, or its own session would not send.
    return (Right(("put",), keys, ("ingress",)), Right(("declare_subscriber",), keys, ("egress",)))


def _hears(*keys: str) -> tuple[Right, ...]:
    return (Right(("declare_subscriber",), keys, ("ingress",)), Right(("put",), keys, ("egress",)))


def _asks(*keys: str) -> tuple[Right, ...]:
    return (Right(("query",), keys, ("ingress",)), Right(("reply", "declare_queryable"), keys, ("egress",)))


def _answers(*keys: str) -> tuple[Right, ...]:
    return (Right(("reply", "declare_queryable"), keys, ("ingress",)), Right(("query",), keys, ("egress",)))


def _sees_alive(*keys: str) -> tuple[Right, ...]:
    return (
        Right(("declare_liveliness_subscriber", "liveliness_query"), keys, ("ingress",)),
        Right(("liveliness_token",), keys, ("egress",)),
    )


def _is_alive(*keys: str) -> tuple[Right, ...]:
    return (Right(("liveliness_token",), keys, ("ingress",)),)


_RECALLS: Final = (*_hears(*_RECALL), *_asks(*_RECALL), *_sees_alive(*_RECALL))
ROLE_RIGHTS: Final[dict[str, tuple[Right, ...]]] = {
    "vehicle": (
        *_asks(*_MAP, *_CHANGES, *_CERTIFICATES),
        *_hears(*_UPDATES, REVOKED_KEY),
        *_RECALLS,
        Right(("put",), _WANTS, ("egress",)),
        Right(("reply", "declare_queryable"), _STATES, ("egress",)),
        Right(("declare_subscriber",), (*_TRAFFIC, *_HEALTH), ("egress",)),
    ),
    "shard": (
        *_answers(*_CHANGES, *_STATES, *_CERTIFICATES),
        *_asks(*_CERTIFICATES),
        *_puts(*_WANTS, *_UPDATES),
        *_puts(*_RECALL),
        *_answers(*_RECALL),
        *_is_alive(*_RECALL),
        Right(("liveliness_query", "declare_liveliness_subscriber"), _RECALL, ("egress",)),
        *_sees_alive(*_SHARDS_ALIVE),
        *_hears(AUTHORITY_KEYS, *_HEALTH),
    ),
    "tiles": (*_answers(*_MAP, *_CERTIFICATES), *_hears(AUTHORITY_KEYS)),
    "operator": (
        *_asks(*_MAP, *_CERTIFICATES),
        *_hears(*_UPDATES, *_TRAFFIC, *_HEALTH, REVOKED_KEY),
        *_RECALLS,
        *_sees_alive(*_ALIVE),
        *_puts(AUTHORITY_KEYS),
    ),
    "router": (Right(_ALL, _EVERYTHING, ("ingress", "egress")),),
}
"""What everybody in a role may do; another router sees to its own members."""


def _own_rights(member: MemberName) -> tuple[Right, ...]:
    """What only this member may do."""
    name = member.name
    if member.role == "vehicle":
        return (
            Right(("put",), (f"{_V1}/traffic/{name}", f"{_V1}/health/{name}"), ("ingress",)),
            Right(("declare_subscriber",), (f"{_V1}/want/{name}",), ("ingress",)),
            Right(("query",), (f"{_V1}/state/{name}",), ("ingress",)),
            *_is_alive(f"{_V1}/alive/agent/{name}"),
            Right(_OWN_SENSORS, (f"{_V1}/live/{name}/*",), ("ingress", "egress")),
        )
    if member.role == "shard":
        return _is_alive(f"{_V1}/alive/merger/{name}")
    if member.role == "tiles":
        return _is_alive(f"{_V1}/alive/store/{name}")
    return ()


def access_control(members: Iterable[MemberName], *, links: bool = False) -> dict[str, Any]:
    """The `access_control` of zenoh for a router.

    Args:
        members: who belongs; anybody else may do nothing.
        links: whether what comes over a Unix socket is another router (`gate.SecureRouter`'s own; the folder of the
            socket keeps others out).
    """
    by_role: dict[str, list[MemberName]] = {role: [] for role in ROLES}
    for member in sorted(set(members)):
        by_role[member.role].append(member)
    rules, subjects, policies = [], [], []
    for role, rights in ROLE_RIGHTS.items():
        names = [one.common_name for one in by_role[role]]
        subject: dict[str, Any] = {"id": role, "cert_common_names": names, "link_protocols": ["tls"]}
        if names:
            rules += [right.rule(f"{role} {n}") for n, right in enumerate(rights)]
            subjects.append(subject)
            policies.append({"subjects": [role], "rules": [f"{role} {n}" for n in range(len(rights))]})
        for one in by_role[role]:
            if own := _own_rights(one):
                name = one.common_name
                rules += [right.rule(f"{name} {n}") for n, right in enumerate(own)]
                subjects.append({"id": name, "cert_common_names": [name], "link_protocols": ["tls"]})
                policies.append({"subjects": [name], "rules": [f"{name} {n}" for n in range(len(own))]})
    if links or not subjects:  # zenoh takes no empty list: without any member nobody else has rights
        rules.append(Right(_ALL, _EVERYTHING, ("ingress", "egress")).rule("link"))
        subjects.append({"id": "link", "link_protocols": ["unixsock-stream"]})
        policies.append({"subjects": ["link"], "rules": ["link"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
