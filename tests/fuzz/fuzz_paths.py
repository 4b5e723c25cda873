"""Where the modules of the project, of the other tests that lend their samples, and the corpus lie."""

import sys
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve().parent
ROOT: Final = HERE.parents[1]
CORPUS: Final = HERE / "corpus"
_LENDERS: Final = ("schemas", "gnd_map", "survey", "tile_store", "importer", "studies/benchmark", "feature_io")


def add_paths() -> None:
    """Make the samples of other tests importable, as pytest does for their own folders."""
    for folder in (HERE, ROOT, ROOT / "src", *(ROOT / "tests" / name for name in _LENDERS)):
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
