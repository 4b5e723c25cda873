"""Signatures of versions in a store: made when a version is published, kept beside it, checked before it is built upon.

A store in which somebody has signed stays one of signed versions: who has no identity publishes nothing there.
"""

import time
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

from gnd.fleet_bus.errors import IdentityError, NotAnsweredFor, SealError, SignedAhead
from gnd.fleet_bus.identity.names import identity_of_environment
from gnd.fleet_bus.publishers import PublisherKey, Publishers
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.archive_seal import ArchiveSeal, Sealed, SealedPart, SealNumber, sealed_text
from gnd.schemas.catalog_signature import CatalogKind, CatalogSignature, CatalogStatement
from gnd.schemas.district_list import DistrictsHead, DistrictsSignature
from gnd.schemas.version_signature import VersionSignature, VersionStatement
from gnd.tile_store.connection import SqlConnection, change, fetch, post
from gnd.tile_store.errors import ClocksApart, NotPublished, StoreDamaged
from gnd.tile_store.values import NS_PER_S, StoredTile

NOT_SIGNED: Final = {"signer": None, "signed_s": None, "signature": None}


class Signing:
    """Signs what this process publishes, and checks what it builds upon. Safe in several threads.

    Args:
        folder: identity folder of a shard or an operator.

    Raises:
        IdentityError: the folder cannot be read, or its role signs no versions.
    """

    def __init__(self, folder: Path) -> None:
        self._key, self.publishers = PublisherKey(folder), Publishers(folder)

    @classmethod
    def of_environment(cls) -> "Signing | None":
        """With the identity of this process (`--identity`, GND_IDENTITY); None: it has none."""
        folder = identity_of_environment()
        return None if folder is None else cls(folder)

    def sign(self, statement: VersionStatement) -> tuple[VersionSignature, bytes]:
        """The signature under a statement, and the certificates behind it.

        Raises:
            NotPublished: the certificate of this process has ended.
        """
        # clocks step: nothing is signed before it was made
        signed_s = max(time.time_ns() // NS_PER_S, statement.made_s)
        try:
            signer, signature, chain = self._key.sign(lambda signer: statement.text(signer, signed_s), signed_s)
        except IdentityError as error:
            raise NotPublished(f"nothing can be signed, and so nothing published: {error}") from error
        return VersionSignature(signer, statement.kind, statement.made_s, signed_s, signature), chain

    def sign_catalog(
        self, statement: CatalogStatement, kind: CatalogKind, before: CatalogSignature | None
    ) -> tuple[CatalogSignature, bytes]:
        """The signature under the state of a district, and the certificates behind it.

        Args:
            statement: what is signed.
            kind: how it came about.
            before: the signature under the state that it replaces.

        Raises:
            NotPublished: the certificate of this process has ended.
        """
        order = _next(None if before is None else before.order)
        try:
            signer, signature, chain = self._key.sign(
                lambda signer: statement.text(kind, order, signer), order.signed_s
            )
        except IdentityError as error:
            raise NotPublished(f"no catalog can be signed, and so nothing published: {error}") from error
        return CatalogSignature(order.number, order.signed_s, kind, signer, signature), chain

    def sign_districts(
        self, head: DistrictsHead, before: DistrictsSignature | None
    ) -> tuple[DistrictsSignature, bytes]:
        """The signature under a list of districts, and the certificates behind it.

        Args:
            head: what is signed.
            before: the signature under the list that it replaces.

        Raises:
            NotPublished: the certificate of this process has ended.
        """
        order = _next(None if before is None else before.order)
        try:
            signer, signature, chain = self._key.sign(lambda signer: head.text(order, signer), order.signed_s)
        except IdentityError as error:
            raise NotPublished(f"no list of districts can be signed, and so nothing published: {error}") from error
        return DistrictsSignature(order.number, order.signed_s, signer, signature), chain

    def seal(
        self, part: SealedPart, body: bytes, archive: bytes, before: ArchiveSeal | None
    ) -> tuple[ArchiveSeal, bytes]:
        """The seal under a part of an archive, and the certificates behind it.

        Args:
            part: what is signed.
            body: its bytes.
            archive: names the archive, 8 bytes.
            before: the seal of the state that it replaces.

        Raises:
            NotPublished: the certificate of this process has ended.
        """
        body_sha, order = sha256(body).digest(), _next(None if before is None else before.order)
        try:
            signer, signature, chain = self._key.sign(
                lambda signer: sealed_text(part, body_sha, archive, order, signer), order.signed_s
            )
        except IdentityError as error:
            raise NotPublished(f"the archive cannot be signed: {error}") from error
        return ArchiveSeal(archive, order.number, order.signed_s, signer, signature), chain

    def answers_for(self, sealed: Sealed, chain: bytes | None) -> bool:
        """Whether one of our publishers has signed a part of an archive; `chain`: certificates that lie with it."""
        try:
            if chain is not None and not self.publishers.knows(sealed.seal.signer):
                self.publishers.learn(chain)
            self.publishers.check(sealed.seal.signer, sealed.seal.signed_s, sealed.text, sealed.seal.signature)
        except SealError:
            return False
        return True


def _next(before: SealNumber | None) -> SealNumber:
    """The order of what is signed now. Clocks step: what replaces another is not older."""
    now_s = time.time_ns() // NS_PER_S
    return SealNumber(now_s, 1) if before is None else SealNumber(max(now_s, before.signed_s), before.number + 1)


def columns(c: SqlConnection, signing: Signing | None, row: Mapping[str, Any], day: int) -> dict[str, Any]:
    """The columns of a version's signature.

    Args:
        c: in the version's transaction.
        signing: of this process.
        row: the version's other columns.
        day: when the world looked so.

    Raises:
        NotPublished: the store's versions are signed, and this process has no identity, or one that has ended.
    """
    if signing is None:
        if fetch(c, "any_publisher"):
            raise NotPublished(
                f"tile {TileId(row['tile']).path} of layer {row['layer']}: the versions of this store are signed;"
                " publish with the identity of a shard or an operator (--identity FOLDER)"
            )
        return dict(NOT_SIGNED)
    made_s = row["created_ns"] // NS_PER_S
    signature, chain = signing.sign(
        VersionStatement(row["layer"], TileId(row["tile"]), row["version"], row["sha"], row["kind"], day, made_s)
    )
    post(c, "put_publisher", {"signer": signature.signer, "chain": chain, "since_s": signature.signed_s})
    return {"signer": signature.signer, "signed_s": signature.signed_s, "signature": signature.signature}


def sign_again(c: SqlConnection, signing: Signing | None, stored: StoredTile) -> None:
    """Put another signature under a version: of who runs this process, with the time of now."""
    row = {"layer": stored.layer, "tile": stored.tile.morton, "version": stored.version}
    row |= {"sha": stored.sha, "kind": stored.kind, "created_ns": stored.created_ns}
    change(c, "set_signature", row | columns(c, signing, row, stored.day))


def check_signed(c: SqlConnection, signing: Signing | None, stored: StoredTile | None) -> None:
    """Whether a version is what one of our publishers has signed; a process without an identity takes what is there.

    Raises:
        ClocksApart: not yet, by the clock of here.
        StoreDamaged: it is not; nothing is to be made of it.
    """
    if signing is None or stored is None:
        return
    try:
        who_signed(c, signing.publishers, stored)
    except SignedAhead as error:
        raise ClocksApart(
            f"tile {stored.tile.path} of layer {stored.layer} version {stored.version}: {error}"
        ) from error
    except SealError as error:
        raise StoreDamaged(
            f"tile {stored.tile.path} of layer {stored.layer} version {stored.version}: {error};"
            " see `gnd map verify --signatures`"
        ) from error


def who_signed(c: SqlConnection, publishers: Publishers, stored: StoredTile) -> str:
    """Role and name of the publisher that answers for a version.

    Raises:
        SealError: nobody does who may; why.
    """
    signed = stored.signature
    if signed is None:
        raise NotAnsweredFor("unsigned", "not signed (`gnd map sign`)")
    if not publishers.knows(signed.signer):
        rows = fetch(c, "chain_of_publisher", {"signer": signed.signer})
        if not rows:
            raise NotAnsweredFor("unknown", f"the store has no certificate {signed.signer.hex()}")
        publishers.learn(rows[0][0])
    text = stored.statement.text(signed.signer, signed.signed_s)
    return str(publishers.check(signed.signer, signed.signed_s, text, signed.signature))


def who_answers(
    c: SqlConnection, publishers: Publishers, signed: CatalogSignature | DistrictsSignature, text: bytes
) -> str:
    """Role and name of the publisher that has signed a text; the store may have the certificates.

    Raises:
        SealError: nobody has who may; why.
    """
    if not publishers.knows(signed.signer):
        chain = chain_of(c, signed.signer)
        if chain is not None:
            publishers.learn(chain)
    return str(publishers.check(signed.signer, signed.signed_s, text, signed.signature))


def chain_of(c: SqlConnection, signer: bytes) -> bytes | None:
    """The certificates of somebody who has signed versions of the store; None: nobody of that id has."""
    rows = fetch(c, "chain_of_publisher", {"signer": signer})
    return bytes(rows[0][0]) if rows else None
