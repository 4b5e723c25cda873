"""What the server says of one tile among many."""

from dataclasses import dataclass
from typing import Final, Literal

from gnd.gnd_map.content import AnyTile, TileT, dated, decode_content
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, WrongHash
from gnd.schemas.tiles import as_kind, check_day, check_hash, tile_from_delta
from gnd.schemas.version_signature import VersionSignature
from gnd.schemas.wire import check_length, check_version, check_word, refusing

ANSWER_HASH_BYTES: Final = 4
"""So much of a hash goes with what is brought. Bodies have checksums of their own, the base of a delta is agreed upon
in the request, and the next request's digest is made of whole hashes: what slips through is found then.
"""

AnswerStatus = Literal["blob", "delta", "unchanged", "absent", "later", "hash"]
ANSWER_STATUS: Final[dict[int, AnswerStatus]] = {
    1: "blob",
    2: "delta",
    3: "unchanged",
    4: "absent",
    5: "later",
    6: "hash",
}
WITH_BODY: Final = ("blob", "delta")


@dataclass(frozen=True, slots=True)
class TileAnswer:
    """What the server says of one tile: `blob` and `delta` bring a version, `later` did not fit, `hash` = ask again
    with hashes.
    """

    status: AnswerStatus
    version: int = 0
    """New version of a blob or delta; else 0."""
    sha: bytes = b""
    """First 4 bytes of the hash of a blob's or delta's content; else empty."""
    codec_id: int = 0
    """Codec of a blob; else 0."""
    body: bytes = b""
    """Of a blob in its codec, or of a delta by `gnd.gnd_map.content.encode_content_delta`; else empty."""
    day: int = UNKNOWN_DAY
    """When the world looked as a blob or delta says (`gnd.gnd_map.day`); else not known."""
    signature: VersionSignature | None = None
    """Of who answers for a blob's or delta's version; None: nobody does."""

    def __post_init__(self) -> None:
        check_word(self.status, ANSWER_STATUS, "answer status")
        check_length("TileAnswer", len(self.body), limits.MAX_TILE_BODY_BYTES, "bytes")
        check_day(self.day)
        if self.status in WITH_BODY:
            check_version("tile version", self.version, lowest=1)
            check_version("codec id", self.codec_id, lowest=0)
            good = len(self.sha) == ANSWER_HASH_BYTES and (self.status == "blob" or self.codec_id == 0)
        else:
            told = (self.version, self.sha, self.codec_id, self.body, self.day, self.signature)
            good = told == (0, b"", 0, b"", UNKNOWN_DAY, None)
        if not good:
            raise BadValue(
                f"answer {self.status!r} with version {self.version}, a hash of {len(self.sha)} bytes, codec"
                f" {self.codec_id} and {len(self.body)} bytes"
            )


def tile_of_answer(tile: TileId, answer: TileAnswer, held: Tile | None = None) -> Tile:
    """As `content_of_answer`, of a layer of Gaussians."""
    return content_of_answer(tile, answer, Tile, held)


def content_of_answer(tile: TileId, answer: TileAnswer, kind: type[TileT], held: TileT | None = None) -> TileT:
    """The tile that a "blob" or "delta" brings.

    Args:
        tile: which tile the answer is about.
        answer: of status "blob" or "delta".
        kind: what the layer holds: `Tile` of Gaussians or `FeatureTile`.
        held: the content that the request said is held; needed by a delta.

    Raises:
        WrongHash: the content has not its hash, or the delta does not fit what is held: fetch the tile whole.
        BadValue: an unknown codec, a body that is none of it, content of the other kind, an answer without a body.
    """
    if answer.status not in WITH_BODY:
        raise BadValue(f"answer {answer.status!r} about tile {tile} brings no content")
    name = f"tile {tile} version {answer.version}"
    if answer.status == "delta":
        if held is None:
            raise WrongHash(f"{name} is a delta and nothing is held; fetch the tile whole")
        return dated(tile_from_delta(tile, answer.version, answer.body, held, answer.sha), answer.day)
    with refusing(name):
        found: AnyTile = decode_content(tile, answer.version, answer.codec_id, answer.body)
    check_hash(name, found, answer.sha)
    return dated(as_kind(found, kind), answer.day)
