"""`gnd certs`: the authority of a fleet, and the identities that it issues."""

import datetime as dt
import json
from pathlib import Path
from typing import Any

import click

from gnd.answers import json_option, tell
from gnd.deploy.errors import DeployError
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import IdentityError
from gnd.fleet_bus.identity.names import ROLES, MemberName, identity_of_environment
from gnd.schemas.keys import authority_key

PATH = click.Path(path_type=Path)
_AUTHORITY = click.option(
    "--authority", type=PATH, default=Path("authority"), show_default=True, help="Folder of the authority."
)
_DAYS = click.option("--days", type=click.FloatRange(min=0), default=0.0, help="How long it holds.  [default: 7 or 30]")
_TO = click.option("--to", "folders", type=PATH, multiple=True, help="Identity folder of a router; repeatable.")
_CONNECT = click.option("--connect", help="A router that hears of it at once, with --identity of an operator.")
_IDENTITY = click.option("--identity", type=PATH, help="Identity folder of the operator who tells the router.")


@click.group()
def certs() -> None:
    """Issue, renew and revoke the certificates of vehicles, shards, tile servers, operators and routers."""


@certs.command(short_help="Make an authority.")
@_AUTHORITY
@click.option("--name", default="GND fleet", show_default=True, help="Its common name.")
@json_option
def init(authority: Path, name: str, as_json: bool) -> None:
    """Make an authority: a root that holds ten years, and an empty register. Its folder belongs on no server."""
    from gnd.fleet_bus.identity.authority import Authority

    Authority.create(authority, name)
    key = authority / "key.pem"
    values = {"authority": str(authority), "name": name, "key": str(key)}
    tell(values, as_json, f"authority {name!r} in {authority}: keep {key} where no server reads it")


def _issuing(role: str) -> click.Command:
    @click.argument("name")
    @_AUTHORITY
    @click.option("--out", type=PATH, help=f"Identity folder.  [default: {role}.NAME]")
    @click.option("--owner", default="", help="Organisation that it belongs to.")
    @_DAYS
    @_TO
    @_CONNECT
    @_IDENTITY
    @json_option
    def issue(
        name: str, authority: Path, out: Path | None, owner: str, days: float, as_json: bool, **options: Any
    ) -> None:
        from gnd.fleet_bus.identity.authority import Authority

        opened, member = Authority(authority), MemberName(role, name)
        folder = out or Path(member.common_name)
        hosts = options.pop("hosts", ())
        entry = opened.issue(member, folder, owner=owner, hosts=hosts, days=days)
        told = _publish(opened, **options)
        values = {"member": member.common_name, "folder": str(folder), "ends": entry.ends, "told": told}
        tell(values, as_json, f"{member.common_name} in {folder}, until {entry.ends}", *_told(told))

    issue.__doc__ = f"Issue the identity of the {_SPOKEN[role]} NAME, and say so to routers."
    if role == "router":
        host = click.option("--host", "hosts", multiple=True, help="Name or address under which it is reached.")
        issue = host(issue)
    return click.command(name=role, short_help=f"Issue the identity of {_ARTICLES.get(role, 'a')} {_SPOKEN[role]}.")(
        issue
    )


_SPOKEN = {
    "vehicle": "vehicle",
    "shard": "merger shard",
    "tiles": "tile server",
    "operator": "operator",
    "router": "router",
}
_ARTICLES = {"operator": "an"}
for _role in ROLES:
    certs.add_command(_issuing(_role))


@certs.command(short_help="Issue a vehicle's pseudonyms.")
@click.argument("name")
@_AUTHORITY
@click.option("--out", type=PATH, help="Folder of pseudonyms.  [default: pseudonyms.NAME]")
@click.option("--count", type=int, default=7, show_default=True, help="For so many periods, the present one included.")
@click.option("--hours", type=float, default=24.0, show_default=True, help="Length of a period; of all vehicles alike.")
@click.option("--owner", default="", help="Organisation, for all to read: it links vehicles of a small owner.")
@_TO
@_CONNECT
@_IDENTITY
@json_option
def pseudonyms(name: str, authority: Path, out: Path | None, owner: str, as_json: bool, **options: Any) -> None:
    """Issue the vehicle NAME an identity for each day, under names that tell nobody but the authority whose they are.

    What the folder holds already stays. `gnd agent --identity FOLDER` takes the present one for each trip.
    """
    from gnd.fleet_bus.identity.authority import Authority
    from gnd.fleet_bus.identity.pseudonyms import issue_pseudonyms

    opened, folder = Authority(authority), out or Path(f"pseudonyms.{name}")
    count, hours = options.pop("count"), options.pop("hours")
    issued = issue_pseudonyms(opened, name, folder, count=count, hours=hours, owner=owner)
    last = f", the last until {issued[-1].ends}" if issued else ""
    told = _publish(opened, **options)
    values = {"vehicle": name, "folder": str(folder), "count": count, "new": len(issued), "told": told}
    tell(values, as_json, f"{len(issued)} of {count} pseudonyms of {name} are new in {folder}{last}", *_told(told))


@certs.command(short_help="Whose a pseudonym is.")
@click.argument("names", nargs=-1, required=True)
@_AUTHORITY
@click.option("--all", "every", is_flag=True, help="NAMES are vehicles: list all pseudonyms of each.")
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
def whose(names: tuple[str, ...], authority: Path, every: bool, as_json: bool) -> None:
    """Say which vehicle is behind each pseudonym: only the authority's key can."""
    from gnd.fleet_bus.identity.authority import Authority
    from gnd.fleet_bus.identity.pseudonyms import pseudonyms_of
    from gnd.fleet_bus.identity.pseudonyms import whose as holder_of

    opened = Authority(authority)
    if every:
        pairs = [(entry.name, name) for name in names for entry in pseudonyms_of(opened, name)]
    else:
        pairs = [(name, holder_of(opened, name)) for name in names]
    if as_json:
        click.echo(json.dumps(dict(pairs), indent=2))
        return
    for pseudonym, holder in pairs:
        click.echo(f"{pseudonym}  {holder}")


@certs.command(short_help="Shut a member out.")
@click.argument("member")
@_AUTHORITY
@_TO
@_CONNECT
@_IDENTITY
@json_option
def revoke(member: str, authority: Path, as_json: bool, **options: Any) -> None:
    """Take back every certificate of MEMBER, such as vehicle.v-17, and tell routers: they cut it off within seconds.

    Of a vehicle all its pseudonyms are taken back, too.
    """
    from gnd.fleet_bus.identity.authority import Authority
    from gnd.fleet_bus.identity.pseudonyms import with_pseudonyms

    opened = Authority(authority)
    names = with_pseudonyms(opened, MemberName.parse(member))
    gone = [(one.common_name, entry) for one in names for entry in opened.revoke(one)]
    lines = [f"{one}: certificate {of.serial} is revoked; it would have held until {of.ends}" for one, of in gone]
    told = _publish(opened, **options)
    revoked = [{"member": one, "serial": entry.serial, "ends": entry.ends} for one, entry in gone]
    tell({"revoked": revoked, "told": told}, as_json, *lines, *_told(told))


@certs.command(short_help="Tell routers who belongs and who is revoked.")
@_AUTHORITY
@_TO
@_CONNECT
@_IDENTITY
@json_option
def publish(authority: Path, as_json: bool, **options: Any) -> None:
    """Put the lists of members and of the revoked into identity folders (--to), or on the bus (--connect)."""
    from gnd.fleet_bus.identity.authority import Authority

    if not options["folders"] and options["connect"] is None:
        raise DeployError("nobody to tell: name --to FOLDER or --connect ENDPOINT")
    told, folders = _publish(Authority(authority), **options), [str(one) for one in options["folders"]]
    lines = [f"members and revoked are in {folder}" for folder in folders]
    tell({"folders": folders, "told": told}, as_json, *lines, *_told(told))


@certs.command(short_help="Sign a router's list of members with a PKI of your own.")
@click.argument("names", nargs=-1, metavar="MEMBER...")
@click.option("--key", type=PATH, required=True, help="Private key of an authority that the router trusts, PEM.")
@click.option("--to", "folder", type=PATH, required=True, help="Identity folder of the router.")
@click.option("--revoked", multiple=True, metavar="MEMBER", help="Who is shut out; repeatable.")
@json_option
def members(names: tuple[str, ...], key: Path, folder: Path, revoked: tuple[str, ...], as_json: bool) -> None:
    """Sign the list of all members, for a router whose certificates do not come from `gnd certs`.

    A MEMBER is a name such as vehicle.v-17, or a certificate in PEM. The list replaces the one in the folder under the
    next number; a running router takes it up by itself.
    """
    from gnd.fleet_bus.identity.foreign import sign_members

    listed = sign_members(folder, key, map(_named, names), map(_named, revoked))
    values = {"folder": str(folder), "number": listed.number}
    values |= {"members": len(listed.members), "revoked": len(listed.revoked)}
    line = f"list {listed.number} in {folder}: {len(listed.members)} members, {len(listed.revoked)} shut out"
    tell(values, as_json, line)


def _named(text: str) -> MemberName:
    """The member of a name or of a certificate's file."""
    from gnd.fleet_bus.identity.foreign import member_of_file

    return member_of_file(Path(text)) if Path(text).is_file() else MemberName.parse(text)


@certs.command(short_help="Renew certificates.")
@click.argument("folders", nargs=-1, required=True, type=PATH)
@_AUTHORITY
@_DAYS
@click.option("--all", "every", is_flag=True, help="Those too that hold for long yet.")
@json_option
def renew(folders: tuple[Path, ...], authority: Path, days: float, every: bool, as_json: bool) -> None:
    """Renew the identities in FOLDERS that end soon (in less than a quarter of their time), with new keys.

    A running process takes the new certificate from its folder by itself.
    """
    from gnd.fleet_bus.identity.authority import Authority
    from gnd.fleet_bus.identity.folder import load_identity

    opened, rows = Authority(authority), []
    for folder in folders:
        identity = load_identity(folder)
        is_new = every or identity.ends_soon()
        ends = opened.renew(folder, days).ends if is_new else identity.ends.isoformat()
        rows.append({"member": identity.member.common_name, "folder": str(folder), "renewed": is_new, "ends": ends})
    words = {True: "renewed", False: "holds"}
    lines = [f"{row['member']} in {row['folder']}: {words[bool(row['renewed'])]} until {row['ends']}" for row in rows]
    tell({"identities": rows}, as_json, *lines)


@certs.command(name="list", short_help="What was issued.")
@_AUTHORITY
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
def list_(authority: Path, as_json: bool) -> None:
    """The register: what was issued to whom, until when, and what was revoked."""
    from dataclasses import asdict

    from gnd.fleet_bus.identity.authority import Authority

    entries = Authority(authority).entries()
    if as_json:
        click.echo(json.dumps([asdict(entry) for entry in entries], indent=2))
        return
    now = dt.datetime.now(dt.UTC)
    for entry in entries:
        state = f"revoked {entry.revoked}" if entry.revoked else "holds" if entry.holds(now) else "ended"
        click.echo(f"{entry.member.common_name:32} {entry.owner:16} {entry.begins} {entry.ends} {state}")


@certs.command(short_help="What is wrong with an identity folder.")
@click.argument("folder", type=PATH)
@click.option("--connect", help="Also try this router, tls/host:port.")
@json_option
def check(folder: Path, connect: str | None, as_json: bool) -> None:
    """Check the identity in FOLDER, from whatever PKI it comes: files, key, chain, name, time, list of the revoked."""
    from gnd.fleet_bus.identity.cause import why_not
    from gnd.fleet_bus.identity.folder import load_identity, problems

    identity = load_identity(folder)
    found = problems(identity)
    if connect is not None and not found:
        cause = why_not(connect, folder)
        found = [f"{connect}: {cause}"] if cause else []
    if found:
        raise IdentityError("; ".join(found))
    name, ends = identity.member.common_name, identity.ends.isoformat()
    values = {"member": name, "owner": identity.owner, "ends": ends}
    tell(values, as_json, f"{name} ({identity.owner or 'no owner'}): holds until {ends}")


def _publish(authority: Any, folders: tuple[Path, ...], connect: str | None, identity: Path | None) -> str | None:
    """Put the lists into folders and on the bus; gives the router that was told."""
    authority.copy_lists(folders)
    if connect is None:
        return None
    config = BusConfig(connect=(connect,), identity=identity or identity_of_environment())
    with open_bus(config, name="certs") as bus:
        for name, data in zip(("members", "revoked"), authority.lists(), strict=True):
            bus.publish(authority_key(name), data, kind="control")
    return connect


def _told(router: str | None) -> list[str]:
    return [] if router is None else [f"told {router}"]
