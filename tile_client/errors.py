"""What can go wrong with an archive that is read over HTTP; every message is one line.

GndError
└── ArchiveError          an archive, or a part of it, is not to be had
    ├── ArchiveAway       nobody answers, or not in time; another try may help
    └── ArchiveWrong      what came is not what it should be: too long, cut off, of another tile, not signed
        └── ArchiveStale  what came was right once; another try helps where a cache was behind
└── SeenDamaged           a file of what was seen is not what was written
"""

from gnd.gnd_map.errors import GndError


class ArchiveError(GndError):
    """An archive, or a part of it, is not to be had."""


class ArchiveAway(ArchiveError):
    """The server does not answer, not in time, or says that it cannot now."""


class ArchiveWrong(ArchiveError):
    """What came is not what it should be."""


class ArchiveStale(ArchiveWrong):
    """What came is an older state than another part of the archive names."""


class SeenDamaged(GndError):
    """A file of which states were seen is none, or was changed."""
