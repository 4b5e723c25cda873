"""Which vehicles share a namespace, and the addresses of their links."""

import re
from dataclasses import dataclass, replace
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.fleet_config import MAX_AGENTS
from gnd.fleet_bus.links import LinkProfile, load_link

DEFAULT_GROUPS: Final = "3g:1,4g:1,5g:1"
PREFIX: Final = "gndlab"
_NAME: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,19}")
_ROUTER_PORT: Final = 7447


@dataclass(frozen=True, slots=True)
class Group:
    """Vehicles on links of one profile, in one network namespace.

    Attributes:
        name: unique within the lab.
        link: the profile of each vehicle's own link.
        first: number of its first vehicle within the fleet.
        count: how many vehicles.
    """

    name: str
    link: LinkProfile
    first: int
    count: int

    @property
    def vehicles(self) -> range:
        """Numbers of its vehicles within the fleet."""
        return range(self.first, self.first + self.count)


@dataclass(frozen=True, slots=True)
class LabLink:
    """The link of one vehicle: a pair of interfaces, one in the group's namespace, one in the cloud's.

    Attributes:
        number: of the vehicle within the fleet, 0 ... 199.
        profile: rate, delay, jitter, loss.
        vehicle_namespace: where the vehicle's process runs.
        cloud_namespace: where router, store and mergers run.
    """

    number: int
    profile: LinkProfile
    vehicle_namespace: str
    cloud_namespace: str

    @property
    def vehicle_device(self) -> str:
        """Name of the interface on the vehicle's side."""
        return f"v{self.number:02d}"

    @property
    def cloud_device(self) -> str:
        """Name of the interface on the cloud's side."""
        return f"c{self.number:02d}"

    @property
    def vehicle_address(self) -> str:
        """Address of the vehicle's side; 198.18.0.0/15 is set aside for measurements (RFC 2544)."""
        return f"198.18.{self.number}.2"

    @property
    def cloud_address(self) -> str:
        """Address of the cloud's side, at which this vehicle finds the router."""
        return f"198.18.{self.number}.1"

    @property
    def endpoint(self) -> str:
        """The router as this vehicle reaches it."""
        return f"tcp/{self.cloud_address}:{_ROUTER_PORT}"


ROUTER_LISTENS: Final = f"tcp/0.0.0.0:{_ROUTER_PORT}"
ROUTER_FROM_CLOUD: Final = f"tcp/127.0.0.1:{_ROUTER_PORT}"


def parse_groups(text: str) -> tuple[Group, ...]:
    """Read groups as "3g:2,4g:4,mine.toml:1" (profile or file, then the number of vehicles; the last colon counts).

    Raises:
        LabError: malformed, empty, or too many vehicles.
        LinkError: unknown profile.
    """
    groups: list[Group] = []
    words = [word for word in (part.strip() for part in text.split(",")) if word]
    if len(words) > MAX_AGENTS:
        raise LabError(f"{len(words)} groups: at most {MAX_AGENTS}, of one vehicle each")
    for word in words:
        profile, count = _split(word)
        groups.append(Group(_unused(profile.name, groups), profile, sum(g.count for g in groups), count))
    total = sum(group.count for group in groups)
    if not 1 <= total <= MAX_AGENTS:
        raise LabError(f"groups {text!r} hold {total} vehicles: it must be 1 to {MAX_AGENTS}")
    return tuple(groups)


def _split(word: str) -> tuple[LinkProfile, int]:
    name, _, count = word.rpartition(":")
    if not (name and count.isdecimal() and len(count) <= 6 and int(count) > 0):
        raise LabError(f"group {word!r} is not like 4g:2 (profile, colon, number of vehicles)")
    return load_link(name), int(count)


def _unused(profile: str, groups: list[Group]) -> str:
    """Return a name for a group that makes a fine namespace and is not taken by another group."""
    clean = re.sub("[^a-z0-9]+", "-", profile.lower()).strip("-")[:12] or "group"
    taken = {group.name for group in groups}
    return next(name for name in (clean, *(f"{clean}-{n}" for n in range(2, MAX_AGENTS + 2))) if name not in taken)


def is_lab_name(name: str) -> bool:
    """Whether a lab can have this name."""
    return _NAME.fullmatch(name) is not None


def check_lab_name(name: str) -> str:
    """Return the name of a lab, or raise `LabError` where it cannot be part of a namespace's name."""
    if not is_lab_name(name):
        raise LabError(f"a lab's name is 1 to 20 of a-z, 0-9 and -, beginning with a letter or digit; got {name!r}")
    return name


def namespace_name(lab: str, part: str) -> str:
    """Return the name of one of a lab's namespaces. The dot cannot be part of a lab's name, so none is ambiguous."""
    return f"{PREFIX}.{lab}.{part}"


def links_of(lab: str, groups: tuple[Group, ...]) -> tuple[LabLink, ...]:
    """Return the link of each vehicle, in the order of their numbers."""
    cloud = namespace_name(lab, "cloud")
    return tuple(
        LabLink(number, group.link, namespace_name(lab, f"vehicles-{group.name}"), cloud)
        for group in groups
        for number in group.vehicles
    )


def unpaced(link: LinkProfile) -> LinkProfile:
    """Return the profile for the sessions of a vehicle whose link the network itself shapes."""
    return replace(link, paced=False)
