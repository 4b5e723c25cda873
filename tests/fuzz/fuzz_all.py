"""All targets, by name."""

from typing import Final

import targets_bus
import targets_codecs
import targets_drives
import targets_files
import targets_security
from fuzz_target import FuzzTarget

_MODULES = (targets_bus, targets_codecs, targets_drives, targets_files, targets_security)
TARGETS: Final[dict[str, FuzzTarget]] = {one.name: one for module in _MODULES for one in module.TARGETS}
