"""Pseudonyms: a vehicle's identities for a day each, which only the authority can tell to be of the same vehicle.

A folder of pseudonyms holds one identity folder a period, named by the period's begin. All vehicles' periods begin at
the same times, names and keys are drawn anew, and no field of a certificate says to whom it was issued, unless it names
an owner. The register beside the authority keeps that encrypted with a key that is derived from the authority's own.
"""

import base64
import datetime as dt
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.authority import Authority, RegisterEntry
from gnd.fleet_bus.identity.folder import CERTIFICATE, load_identity, utc_now
from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE, MemberName, identity_of_environment

PERIOD_HOURS: Final = 24.0
COUNT: Final = 7
MAX_COUNT: Final = 400
_ALPHABET: Final = "abcdefghijkmnpqrstuvwxyz23456789"
_LETTERS: Final = 11  # 55 bits: none twice among 10^8 but by chance, and the register is asked
_NAME_BYTES: Final = 64
_NONCE_BYTES: Final = 12
_FORM: Final = "%Y%m%dT%H%M%SZ"
_EARLY: Final = dt.timedelta(minutes=5)
_EPOCH: Final = dt.datetime(2020, 1, 1, tzinfo=dt.UTC)


@dataclass(frozen=True, slots=True)
class Period:
    """A time in which every vehicle has one pseudonym.

    Attributes:
        begins: UTC.
        hours: its length; the certificate holds twice as long, so that a trip that has begun can end.
    """

    begins: dt.datetime
    hours: float

    def __post_init__(self) -> None:
        if not 1.0 / 60 <= self.hours <= 24 * 31:
            raise IdentityError(f"a pseudonym of {self.hours:g} h; a minute to 31 days is possible")

    @classmethod
    def at(cls, now: dt.datetime, hours: float) -> "Period":
        """The one that a time lies in. They are counted from 2020 on, for all vehicles alike."""
        length = cls(now, hours).length
        return cls(_EPOCH + (now - _EPOCH) // length * length, hours)

    @property
    def length(self) -> dt.timedelta:
        """Whole seconds, so that the begins of all periods are, too."""
        return dt.timedelta(seconds=round(3600 * self.hours))

    @property
    def next(self) -> "Period":
        """The one that follows."""
        return Period(self.begins + self.length, self.hours)

    @property
    def last_second(self) -> dt.datetime:
        """When its certificate ends."""
        return self.begins + 2 * self.length

    @property
    def folder(self) -> str:
        """Name of its identity folder."""
        return self.begins.strftime(_FORM)


def issue_pseudonyms(
    authority: Authority, holder: str, out: Path, *, count: int = COUNT, hours: float = PERIOD_HOURS, owner: str = ""
) -> list[RegisterEntry]:
    """Fill a folder with pseudonyms for the present period and those that follow; what is there already stays.

    Args:
        authority: that issues.
        holder: the vehicle, by the name that the authority knows it by.
        out: folder of pseudonyms.
        count: so many periods, the present one included.
        hours: length of a period.
        owner: organisation, in each certificate for all to read: it links what an owner of few vehicles does.

    Raises:
        IdentityError: the holder's name cannot be one, or numbers are out of bounds.
    """
    MemberName("vehicle", holder)
    if not 1 <= count <= MAX_COUNT:
        raise IdentityError(f"{count} pseudonyms at once; 1 to {MAX_COUNT} are possible")
    taken = {entry.name for entry in authority.entries()}
    period, issued = Period.at(utc_now(), hours), []
    for _ in range(count):
        folder = out / period.folder
        if not (folder / CERTIFICATE).exists():
            name = _new_name(taken)
            taken.add(name)
            issued.append(
                authority.issue(
                    MemberName("vehicle", name),
                    folder,
                    owner=owner,
                    begins=period.begins - _EARLY,
                    ends=period.last_second,
                    holder=_sealed(authority, holder),
                )
            )
        period = period.next
    return issued


def whose(authority: Authority, name: str) -> str:
    """The vehicle behind a pseudonym; only who holds the authority's key can say.

    Raises:
        IdentityError: nothing was issued under this name, or not as a pseudonym.
    """
    found = [entry for entry in authority.entries() if entry.member == MemberName("vehicle", name)]
    if not found:
        raise IdentityError(f"{name}: the register in {authority.folder} knows no such vehicle")
    if not found[-1].holder:
        raise IdentityError(f"{name} is no pseudonym: it is the vehicle's own name")
    return _opened(authority, found[-1].holder)


def pseudonyms_of(authority: Authority, holder: str) -> list[RegisterEntry]:
    """What was issued to a vehicle under other names, oldest first."""
    return [entry for entry in authority.entries() if entry.holder and _opened(authority, entry.holder) == holder]


def with_pseudonyms(authority: Authority, member: MemberName) -> list[MemberName]:
    """The names of a member that still hold: of a vehicle its own, if it has one, and its pseudonyms'.

    A name of which nothing holds stands alone: to take it back is an error that says so.
    """
    now = utc_now()
    known = {entry.member for entry in authority.entries() if entry.holds(now)}
    others = []
    if member.role == "vehicle":
        others = [entry.member for entry in pseudonyms_of(authority, member.name) if entry.holds(now)]
    return [*([member] if member in known or not others else []), *others]


def is_folder_of_pseudonyms(folder: Path) -> bool:
    """Whether a folder holds identities by period, and is none itself."""
    return not (folder / CERTIFICATE).exists() and bool(_periods(folder))


def present_pseudonym(folder: Path, now: dt.datetime | None = None) -> Path:
    """The identity folder whose period has begun last.

    Raises:
        IdentityError: none holds now.
    """
    now = now or utc_now()
    begun = [one for begins, one in _periods(folder) if begins <= now]
    if begun and load_identity(begun[-1]).ends > now:
        return begun[-1]
    if begun:
        ends = load_identity(begun[-1]).ends
        raise IdentityError(
            f"{folder}: the last pseudonym has ended {ends:%Y-%m-%d %H:%M} UTC (the clock says {now:%Y-%m-%d %H:%M}):"
            " `gnd certs pseudonyms` issues more"
        )
    raise IdentityError(f"{folder}: no pseudonym has begun (the clock says {now:%Y-%m-%d %H:%M} UTC): is it wrong?")


def take_pseudonym() -> tuple[str, Path] | None:
    """Where `GND_IDENTITY` names a folder of pseudonyms: the present name, and that folder; else None.

    From now on the variable names the identity of that name, for this process and those that it starts: a trip keeps
    the name with which it began.

    Raises:
        IdentityError: none holds now.
    """
    folder = identity_of_environment()
    if folder is None or not is_folder_of_pseudonyms(folder):
        return None
    present = present_pseudonym(folder)
    os.environ[IDENTITY_VARIABLE] = str(present)
    return load_identity(present).name, folder


def _periods(folder: Path) -> list[tuple[dt.datetime, Path]]:
    """Begin and identity folder of each period, oldest first."""
    found = []
    for path in sorted(folder.glob("*/" + CERTIFICATE)):
        try:
            begins = dt.datetime.strptime(path.parent.name, _FORM).replace(tzinfo=dt.UTC)
        except ValueError:
            continue
        found.append((begins, path.parent))
    return found


def _new_name(taken: set[str]) -> str:
    while True:
        name = "p" + "".join(secrets.choice(_ALPHABET) for _ in range(_LETTERS))
        if name not in taken:
            return name


def _sealed(authority: Authority, holder: str) -> str:
    nonce = secrets.token_bytes(_NONCE_BYTES)
    padded = holder.encode().ljust(_NAME_BYTES, b"\0")  # its length would tell vehicles apart
    return base64.b64encode(nonce + _cipher(authority.key).encrypt(nonce, padded, None)).decode()


def _opened(authority: Authority, sealed: str) -> str:
    try:
        data = base64.b64decode(sealed, validate=True)
        return _cipher(authority.key).decrypt(data[:_NONCE_BYTES], data[_NONCE_BYTES:], None).rstrip(b"\0").decode()
    except (ValueError, InvalidTag) as error:
        raise IdentityError(f"the register in {authority.folder} was written with another key") from error


def _cipher(key: ec.EllipticCurvePrivateKey) -> AESGCM:
    secret = key.private_numbers().private_value.to_bytes(32, "big")
    return AESGCM(HKDF(hashes.SHA256(), 32, salt=None, info=b"gnd holders of pseudonyms").derive(secret))
