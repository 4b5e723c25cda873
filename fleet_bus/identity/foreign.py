"""Lists of members for routers whose certificates come from a PKI of somebody's own, not from `Authority`."""

from collections.abc import Iterable
from pathlib import Path

from cryptography import x509

from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.folder import AUTHORITY, MEMBERS, certificates_in, load_key, member_of, same_key
from gnd.fleet_bus.identity.lists import MemberList, replace_file
from gnd.fleet_bus.identity.names import MemberName


def member_of_file(path: Path) -> MemberName:
    """The member that a certificate file in PEM names first; `IdentityError`."""
    return member_of(certificates_in(path)[0])


def sign_members(
    folder: Path, key_path: Path, members: Iterable[MemberName], revoked: Iterable[MemberName] = ()
) -> MemberList:
    """Sign who belongs, and put the list into a router's identity folder under the number after the one that is there.

    Args:
        folder: identity folder of the router, with `authority.pem`.
        key_path: private key of one of the authorities in it.
        members: all who belong, not only new ones.
        revoked: who is shut out although their certificates have not ended; none of them is a member.

    Raises:
        IdentityError: the key is of none of the folder's authorities, the present list is not signed by them, or the
            new one would be empty.
    """
    roots = certificates_in(folder / AUTHORITY)
    key = load_key(key_path)
    if not any(same_key(root, key) for root in roots):
        raise IdentityError(f"{key_path} is the key of none of the {len(roots)} authorities in {folder / AUTHORITY}")
    shut = frozenset(one.common_name for one in revoked)
    belong = frozenset(one for one in members if one.common_name not in shut)
    if not belong:
        raise IdentityError(f"a list without members would shut everybody out of {folder}, its router too")
    listed = MemberList(_number(folder, roots) + 1, belong, shut)
    replace_file(folder / MEMBERS, listed.encode(key))
    return listed


def _number(folder: Path, roots: tuple[x509.Certificate, ...]) -> int:
    path = folder / MEMBERS
    return MemberList.decode(path.read_bytes(), roots).number if path.exists() else 0
