"""The common name of a certificate: "<role>.<name>", which the router's rights go by."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from gnd.fleet_bus.errors import IdentityError

ROLES: Final = ("vehicle", "shard", "tiles", "operator", "router")
PUBLISHER_ROLES: Final = ("shard", "operator")
"""Who may sign versions: shards what they merge, operators what they import, roll back or have checked."""
IDENTITY_VARIABLE: Final = "GND_IDENTITY"
"""Environment variable: the identity folder of a process, as `--identity` gives it."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,54}")
MAX_COMMON_NAME: Final = 64
"""Of X.509 (ub-common-name): role, dot and name."""


@dataclass(frozen=True, slots=True, order=True)
class MemberName:
    """Role and name of a member: one chunk of a key, never a wildcard.

    Attributes:
        role: one of `ROLES`.
        name: the id used in the protocol: a vehicle's pseudonym, a shard's id.
    """

    role: str
    name: str

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise IdentityError(f"role {self.role!r} is none of {', '.join(ROLES)}")
        if not _NAME.fullmatch(self.name):
            raise IdentityError(f"name {self.name[:80]!r} must be 1 to 55 of letters, digits, '.', '_', '-'")

    @property
    def common_name(self) -> str:
        """As it stands in the certificate."""
        return f"{self.role}.{self.name}"

    @classmethod
    def parse(cls, common_name: str) -> Self:
        """The member of a common name; `IdentityError` where it is none."""
        role, dot, name = common_name.partition(".")
        if not dot:
            raise IdentityError(f"common name {common_name[:80]!r} is not like vehicle.v-17")
        return cls(role, name)


def identity_of_environment() -> Path | None:
    """The folder that the environment names, None where it names none."""
    folder = os.environ.get(IDENTITY_VARIABLE, "")
    return Path(folder) if folder else None
