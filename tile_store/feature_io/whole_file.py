"""A file that appears whole or not at all."""

import os
from pathlib import Path

from gnd.tile_store.feature_io.errors import FeatureFileError


def write_whole(target: Path, body: bytes) -> None:
    """Write beside the target and rename at the end; FeatureFileError when that cannot be."""
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(body)
        partial.replace(target)
    except OSError as error:
        raise FeatureFileError(f"{target}: cannot write: {error.strerror or error}") from None
    finally:
        partial.unlink(missing_ok=True)
