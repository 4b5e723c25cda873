"""The paper's way to write a tile (4.5: files based on Protocol Buffers): one message a voxel, numbers as they are."""

from functools import cache
from typing import Any, Literal

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

Number = Literal["double", "float"]
_FIELD = descriptor_pb2.FieldDescriptorProto
_KINDS = {"double": _FIELD.TYPE_DOUBLE, "float": _FIELD.TYPE_FLOAT}


def plain_protobuf(tile_id: TileId, gaussians: Gaussians, number: Number) -> bytes:
    """A tile as `message Tile {uint64 id; repeated Voxel voxels;}` with `message Voxel {sint32 id; uint32 count;
    repeated NUMBER mean; repeated NUMBER covariance;}`, three and six numbers, packed.
    """
    tile = _tile_class(number)(id=tile_id.morton)
    rows = zip(*(column.tolist() for column in gaussians.columns), strict=True)
    for voxel_id, count, _, mean, covariance in rows:
        tile.voxels.add(id=voxel_id, count=count, mean=mean, covariance=covariance)
    return bytes(tile.SerializeToString())


@cache
def _tile_class(number: Number) -> Any:
    file = descriptor_pb2.FileDescriptorProto(name=f"plain_{number}.proto", package=f"plain.{number}s", syntax="proto3")
    voxel, tile = file.message_type.add(name="Voxel"), file.message_type.add(name="Tile")
    one, many = _FIELD.LABEL_OPTIONAL, _FIELD.LABEL_REPEATED
    voxel.field.add(name="id", number=1, type=_FIELD.TYPE_SINT32, label=one)
    voxel.field.add(name="count", number=2, type=_FIELD.TYPE_UINT32, label=one)
    voxel.field.add(name="mean", number=3, type=_KINDS[number], label=many)
    voxel.field.add(name="covariance", number=4, type=_KINDS[number], label=many)
    tile.field.add(name="id", number=1, type=_FIELD.TYPE_UINT64, label=one)
    tile.field.add(name="voxels", number=2, type=_FIELD.TYPE_MESSAGE, type_name=f".{file.package}.Voxel", label=many)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{file.package}.Tile"))
