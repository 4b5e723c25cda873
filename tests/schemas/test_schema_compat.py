"""The wire format only grows: what breaks a reader is refused, and generated code is what the sources say."""

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, EnumDescriptorProto, FieldDescriptorProto, FileDescriptorSet

from gnd.schemas import generate
from gnd.schemas.compatibility import breaking_changes
from gnd.schemas.generate import GenerateError

GOLDEN = FileDescriptorSet.FromString(generate.GOLDEN.read_bytes())


def copy() -> FileDescriptorSet:
    files = FileDescriptorSet()
    files.CopyFrom(GOLDEN)
    return files


def message(files: FileDescriptorSet, name: str) -> DescriptorProto:
    return next(m for file in files.file for m in file.message_type if m.name == name)


def field(files: FileDescriptorSet, name: str, number: int) -> FieldDescriptorProto:
    return next(f for f in message(files, name).field if f.number == number)


def ack_status(files: FileDescriptorSet) -> EnumDescriptorProto:
    return message(files, "ChangeAck").enum_type[0]


def remove_field(files: FileDescriptorSet, name: str, number: int) -> None:
    owner = message(files, name)
    del owner.field[[f.number for f in owner.field].index(number)]


def reserve(owner: DescriptorProto, number: int, name: str | None) -> None:
    owner.reserved_range.add(start=number, end=number + 1)
    if name:
        owner.reserved_name.append(name)


def remove_message(files: FileDescriptorSet) -> None:
    for file in files.file:
        if file.name.endswith("change_ack.proto"):
            del file.message_type[0]


def retype(files: FileDescriptorSet) -> None:
    field(files, "TileBlob", 1).type = FieldDescriptorProto.TYPE_SINT64


def renumber(files: FileDescriptorSet) -> None:
    field(files, "TileBlob", 2).number = 12


def rename(files: FileDescriptorSet) -> None:
    field(files, "TileBlob", 2).name = "revision"


def repeat(files: FileDescriptorSet) -> None:
    field(files, "TileBlob", 2).label = FieldDescriptorProto.LABEL_REPEATED


def retarget(files: FileDescriptorSet) -> None:
    field(files, "TileReply", 3).type_name = ".gnd.v1.TileDelta"


def into_oneof(files: FileDescriptorSet) -> None:
    message(files, "TileBlob").oneof_decl.add(name="choice")
    field(files, "TileBlob", 2).oneof_index = 0


def drop(files: FileDescriptorSet) -> None:
    remove_field(files, "ChangeReport", 5)


def drop_reserving_the_number_only(files: FileDescriptorSet) -> None:
    drop(files)
    reserve(message(files, "ChangeReport"), 5, None)


def drop_value(files: FileDescriptorSet) -> None:
    del ack_status(files).value[2]


def rename_value(files: FileDescriptorSet) -> None:
    ack_status(files).value[2].name = "STATUS_AGAIN"


BREAKING: dict[str, tuple[Callable[[FileDescriptorSet], None], str]] = {
    "message removed": (remove_message, "gnd.v1.ChangeAck: message removed"),
    "type": (retype, "gnd.v1.TileBlob: field tile = 1 changes its type from TYPE_UINT64 to TYPE_SINT64"),
    "number": (renumber, "gnd.v1.TileBlob: field version = 2 removed without reserving its number and name"),
    "name": (rename, "gnd.v1.TileBlob: field version = 2 changes its name from version to revision"),
    "label": (repeat, "field version = 2 changes its label from LABEL_OPTIONAL to LABEL_REPEATED"),
    "submessage": (retarget, "field blob = 3 changes its type from .gnd.v1.TileBlob to .gnd.v1.TileDelta"),
    "oneof": (into_oneof, "field version = 2 changes its presence from always to one of a group"),
    "removed": (drop, "gnd.v1.ChangeReport: field software = 5 removed without reserving"),
    "half reserved": (drop_reserving_the_number_only, "field software = 5 removed without reserving"),
    "enum value removed": (drop_value, "gnd.v1.ChangeAck.Status: value STATUS_DUPLICATE = 2 removed without reserving"),
    "enum value renamed": (rename_value, "value 2 changes its name from STATUS_DUPLICATE to STATUS_AGAIN"),
}


@pytest.mark.parametrize(("change", "message_text"), BREAKING.values(), ids=BREAKING)
def test_a_breaking_change_is_named(change: Callable[[FileDescriptorSet], None], message_text: str) -> None:
    changed = copy()
    change(changed)
    assert any(message_text in line for line in breaking_changes(GOLDEN, changed))


def test_an_enum_that_goes_with_its_message_is_named_too() -> None:
    changed = copy()
    remove_message(changed)
    assert "gnd.v1.ChangeAck.Status: enum removed" in breaking_changes(GOLDEN, changed)


def test_additions_and_reserved_removals_break_nothing() -> None:
    changed = copy()
    message(changed, "TileBlob").field.add(
        name="compressed", number=99, type=FieldDescriptorProto.TYPE_BOOL, label=FieldDescriptorProto.LABEL_OPTIONAL
    )
    changed.file.add(name="gnd/v1/new.proto", package="gnd.v1").message_type.add(name="New")
    drop(changed)
    reserve(message(changed, "ChangeReport"), 5, "software")
    drop_value(changed)
    ack_status(changed).reserved_range.add(start=2, end=2)
    ack_status(changed).reserved_name.append("STATUS_DUPLICATE")
    assert breaking_changes(GOLDEN, changed) == []


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the sources and of what is generated from them, for the generator to work on."""
    sources = tmp_path / "schemas"
    (sources / "generated").mkdir(parents=True)
    (sources / "golden").mkdir()
    for path in generate.SOURCES.glob("*.proto"):
        (sources / path.name).write_text(path.read_text())
    for path in generate.GENERATED.glob("*_pb2.py*"):
        (sources / "generated" / path.name).write_text(path.read_text())
    (sources / "golden" / generate.GOLDEN.name).write_bytes(generate.GOLDEN.read_bytes())
    monkeypatch.setattr(generate, "SOURCES", sources)
    monkeypatch.setattr(generate, "GENERATED", sources / "generated")
    monkeypatch.setattr(generate, "GOLDEN", sources / "golden" / generate.GOLDEN.name)
    return sources


def edit(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def test_the_committed_code_is_what_the_sources_say(workspace: Path) -> None:
    generate.check()


def test_a_new_field_is_noticed_by_the_check_and_taken_by_generate(workspace: Path) -> None:
    edit(workspace / "change_ack.proto", "string reason = 4;", "string reason = 4;\n  uint32 waiting = 15;")
    with pytest.raises(GenerateError, match=r"differs .* in change_ack_pb2\.py, change_ack_pb2\.pyi: run"):
        generate.check()
    generate.generate()
    generate.check()
    assert "waiting" in (workspace / "generated" / "change_ack_pb2.pyi").read_text()


def test_hand_edited_and_left_over_code_is_noticed_and_put_right(workspace: Path) -> None:
    edit(workspace / "generated" / "catalog_pb2.pyi", "entries", "items")
    (workspace / "generated" / "forgotten_pb2.py").write_text("")
    with pytest.raises(GenerateError, match=r"in catalog_pb2\.pyi, forgotten_pb2\.py: run"):
        generate.check()
    generate.generate()
    assert not (workspace / "generated" / "forgotten_pb2.py").exists()


def test_a_breaking_change_is_refused_and_nothing_is_written(
    workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (workspace / "generated" / "tile_blob_pb2.py").read_text()
    edit(workspace / "tile_blob.proto", "uint32 version = 2;", "string version = 2;")
    assert generate.main([]) == 1
    error = capsys.readouterr().err
    assert "1 change(s) would break the wire format of gnd.v1" in error
    assert "field version = 2 changes its type from TYPE_UINT32 to TYPE_STRING" in error
    assert (workspace / "generated" / "tile_blob_pb2.py").read_text() == before
    assert generate.main(["--check"]) == 1


def test_sources_that_do_not_compile_are_refused(workspace: Path) -> None:
    edit(workspace / "tile_blob.proto", "uint32 version = 2;", "unit32 version = 2;")
    with pytest.raises(GenerateError, match="protoc failed with status 1"):
        generate.generate()


def test_every_field_has_its_comment() -> None:
    for path in sorted(generate.SOURCES.glob("*.proto")):
        lines = [line.strip() for line in path.read_text().splitlines()]
        for before, line in itertools.pairwise(lines):
            is_field = line.endswith(";") and " = " in line and not line.startswith(("//", "syntax", "reserved"))
            explained = before.startswith("//") or line.startswith(("Status ", "Direction ", "Reason "))
            assert not is_field or explained or line.endswith("UNSPECIFIED = 0;"), f"{path.name}: {line} has no comment"
