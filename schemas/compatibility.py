"""Which changes of the `.proto` files would break readers of older messages.

A reader of yesterday must read today's messages and the other way round: a field may be added; it may be removed when
its number and its name are reserved; nothing else about it may change. The same holds for the values of an enum.
"""

from collections.abc import Iterable, Iterator
from itertools import chain

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorSet,
)


def breaking_changes(old: FileDescriptorSet, new: FileDescriptorSet) -> list[str]:
    """One line for each change from `old` to `new` that an existing reader or writer would not survive."""
    messages_now = dict(_messages(new))
    enums_now = dict(_enums(new))
    return [
        *chain.from_iterable(
            _message_breaks(name, message, messages_now.get(name)) for name, message in _messages(old)
        ),
        *chain.from_iterable(_enum_breaks(name, enum, enums_now.get(name)) for name, enum in _enums(old)),
    ]


def _messages(files: FileDescriptorSet) -> Iterator[tuple[str, DescriptorProto]]:
    for file in files.file:
        for message in file.message_type:
            yield from _with_nested(f"{file.package}.{message.name}", message)


def _with_nested(name: str, message: DescriptorProto) -> Iterator[tuple[str, DescriptorProto]]:
    yield name, message
    for nested in message.nested_type:
        yield from _with_nested(f"{name}.{nested.name}", nested)


def _enums(files: FileDescriptorSet) -> Iterator[tuple[str, EnumDescriptorProto]]:
    for file in files.file:
        yield from ((f"{file.package}.{enum.name}", enum) for enum in file.enum_type)
    for name, message in _messages(files):
        yield from ((f"{name}.{enum.name}", enum) for enum in message.enum_type)


def _message_breaks(name: str, old: DescriptorProto, new: DescriptorProto | None) -> Iterator[str]:
    if new is None:
        yield f"{name}: message removed"
        return
    now = {field.number: field for field in new.field}
    # protobuf's reserved ranges of messages end one past the last number
    reserved = _numbers((r.start, r.end - 1) for r in new.reserved_range)
    for field in old.field:
        if field.number in now:
            yield from _field_breaks(name, field, now[field.number])
        elif field.number not in reserved or field.name not in new.reserved_name:
            yield f"{name}: field {field.name} = {field.number} removed without reserving its number and name"


def _field_breaks(message: str, old: FieldDescriptorProto, new: FieldDescriptorProto) -> Iterator[str]:
    for what, before, after in (
        ("name", old.name, new.name),
        ("type", _type_of(old), _type_of(new)),
        ("label", FieldDescriptorProto.Label.Name(old.label), FieldDescriptorProto.Label.Name(new.label)),
        ("presence", _presence_of(old), _presence_of(new)),
    ):
        if before != after:
            yield f"{message}: field {old.name} = {old.number} changes its {what} from {before} to {after}"


def _type_of(field: FieldDescriptorProto) -> str:
    return field.type_name or FieldDescriptorProto.Type.Name(field.type)


def _presence_of(field: FieldDescriptorProto) -> str:
    return "one of a group" if field.HasField("oneof_index") else "always"


def _enum_breaks(name: str, old: EnumDescriptorProto, new: EnumDescriptorProto | None) -> Iterator[str]:
    if new is None:
        yield f"{name}: enum removed"
        return
    now = {value.number: value.name for value in new.value}
    # protobuf's reserved ranges of enums include the last number
    reserved = _numbers((r.start, r.end) for r in new.reserved_range)
    for value in old.value:
        if value.number in now and now[value.number] != value.name:
            yield f"{name}: value {value.number} changes its name from {value.name} to {now[value.number]}"
        elif value.number not in now and (value.number not in reserved or value.name not in new.reserved_name):
            yield f"{name}: value {value.name} = {value.number} removed without reserving its number and name"


def _numbers(ranges: Iterable[tuple[int, int]]) -> "_Ranges":
    return _Ranges(tuple(ranges))


class _Ranges:
    """Inclusive ranges of numbers; a reserved range may run to the largest number there is."""

    def __init__(self, ranges: tuple[tuple[int, int], ...]) -> None:
        self._ranges = ranges

    def __contains__(self, number: int) -> bool:
        return any(first <= number <= last for first, last in self._ranges)
