"""Who a process is: identity folders, the authority that issues them, and what is wrong with one.

What needs `cryptography` (some 40 ms) is loaded when it is first used: a process without an identity never does.
"""

from typing import TYPE_CHECKING, Any

from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, ROLES, MemberName

if TYPE_CHECKING:
    from gnd.fleet_bus.identity.folder import MemberIdentity, load_identity

__all__ = ["IDENTITY_VARIABLE", "ROLES", "MemberIdentity", "MemberName", "load_identity"]


def __getattr__(name: str) -> Any:
    if name in ("MemberIdentity", "load_identity"):
        from gnd.fleet_bus.identity import folder

        return getattr(folder, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
