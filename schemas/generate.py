"""Generates `schemas/generated` from `schemas/*.proto`, and refuses changes that break the wire format.

`python -m gnd.schemas.generate` writes the code and the golden descriptor set; `--check` only compares, for CI.
Needs the development tools (grpcio-tools, mypy-protobuf).
"""

import argparse
import sys
import tempfile
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorSet

from gnd.schemas.compatibility import breaking_changes
from gnd.schemas.errors import SchemaError

SOURCES = Path(__file__).parent
GENERATED = SOURCES / "generated"
GOLDEN = SOURCES / "golden" / "gnd_v1.binpb"

# Where the files live in protobuf's own name space; on disk they lie flat, one message a file.
PROTO_FOLDER = "gnd/v1"
PROTO_PACKAGE = "gnd.v1"


class GenerateError(SchemaError):
    """The sources do not compile, or would break the wire format, or do not match what is committed."""


def generate() -> None:
    """Write the generated code and the golden descriptor set; `GenerateError` when a change would break readers."""
    files, descriptors = _compile()
    _refuse_breaking(descriptors)
    for stale in _committed().keys() - files.keys():
        (GENERATED / stale).unlink()
    for name, text in files.items():
        (GENERATED / name).write_text(text)
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_bytes(descriptors.SerializeToString(deterministic=True))


def check() -> None:
    """Compare the committed code and descriptor set with the sources; `GenerateError` names what differs."""
    files, descriptors = _compile()
    _refuse_breaking(descriptors)
    committed = _committed()
    different = sorted(n for n in files.keys() | committed.keys() if files.get(n) != committed.get(n))
    if different or descriptors != _golden():
        what = ", ".join(different) or GOLDEN.name
        raise GenerateError(
            f"generated code differs from schemas/*.proto in {what}: run `python -m gnd.schemas.generate`"
        )


def _refuse_breaking(descriptors: FileDescriptorSet) -> None:
    broken = breaking_changes(_golden(), descriptors)
    if broken:
        lines = "\n  ".join(broken)
        raise GenerateError(f"{len(broken)} change(s) would break the wire format of {PROTO_PACKAGE}:\n  {lines}")


def _golden() -> FileDescriptorSet:
    return FileDescriptorSet.FromString(GOLDEN.read_bytes()) if GOLDEN.exists() else FileDescriptorSet()


def _committed() -> dict[str, str]:
    return {path.name: path.read_text() for path in sorted(GENERATED.glob("*_pb2.py*"))}


def _compile() -> tuple[dict[str, str], FileDescriptorSet]:
    """Generated files by name, and the descriptors of all messages (without comments)."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        _protoc(out)
        files = {path.name: _relocated(path.read_text()) for path in sorted((out / PROTO_FOLDER).iterdir())}
        return files, FileDescriptorSet.FromString((out / "descriptors.binpb").read_bytes())


def _protoc(out: Path) -> None:
    from grpc_tools import protoc

    status = protoc.main(
        [
            "protoc",
            f"--plugin=protoc-gen-mypy={Path(sys.executable).parent / 'protoc-gen-mypy'}",
            f"-I{PROTO_FOLDER}={SOURCES}",
            f"-I{Path(protoc.__file__).parent / '_proto'}",
            f"--python_out={out}",
            f"--mypy_out=quiet:{out}",
            f"--descriptor_set_out={out / 'descriptors.binpb'}",
            *(f"{PROTO_FOLDER}/{path.name}" for path in sorted(SOURCES.glob("*.proto"))),
        ]
    )
    if status != 0:
        raise GenerateError(f"protoc failed with status {status}; its messages are above")


def _relocated(code: str) -> str:
    """The generated modules import each other by protobuf's folders; here they are one package."""
    return code.replace(f"from {PROTO_PACKAGE} import", "from . import").replace(
        f"'{PROTO_PACKAGE}.", "'gnd.schemas.generated."
    )


def main(arguments: list[str] | None = None) -> int:
    """The command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m gnd.schemas.generate", description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare only; exit code 1 when something differs")
    try:
        check() if parser.parse_args(arguments).check else generate()
    except GenerateError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
