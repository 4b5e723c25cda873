"""How large each message may be. Checked on the bytes before they are parsed, and on what they unpack to.

The figures allow about ten times what a dense city needs: a tile of 20,000 Gaussians, a report over every tile of a
district of 1.2 km.
"""

from typing import Final

KIB: Final = 1024
MIB: Final = 1024 * KIB

MAX_TILE_REQUEST_BYTES: Final = 1 * KIB
MAX_TILE_BODY_BYTES: Final = 4 * MIB
MAX_TILE_REPLY_BYTES: Final = MAX_TILE_BODY_BYTES + KIB
MAX_TILES_REQUEST_BYTES: Final = 24 * KIB
# One question is about up to four districts, which meet at a corner.
MAX_OTHER_DISTRICTS: Final = 3
MAX_TILES_REPLY_BYTES: Final = MAX_TILE_BODY_BYTES + (1 + MAX_OTHER_DISTRICTS) * 160 * KIB
MAX_CATALOG_BYTES: Final = 128 * KIB
MAX_CHANGE_REPORT_BYTES: Final = 8 * MIB
MAX_PACKED_REPORT_BYTES: Final = 1 * MIB
MAX_PACKED_GAUSSIANS_BYTES: Final = 4 * MIB
MAX_FEATURE_REPORT_BYTES: Final = 1 * MIB
MAX_SURVEY_REPORT_BYTES: Final = 1 * MIB
MAX_CHANGE_ACK_BYTES: Final = 64 * KIB
MAX_REPORT_STATES_BYTES: Final = 64 * KIB
MAX_REPORT_QUESTION_BYTES: Final = 4 * KIB
MAX_TILE_UPDATE_BYTES: Final = MAX_TILE_BODY_BYTES + KIB
MAX_TRAFFIC_SAMPLE_BYTES: Final = 16 * KIB

# A district (q5/q10/q15) is 32 x 32 tiles.
MAX_TILES_OF_DISTRICT: Final = 1024
DISTRICTS: Final = 2**29
# A published archive: an index takes some 20 bytes a tile, and its district has few packs.
MAX_ARCHIVE_INDEX_BYTES: Final = 128 * KIB
MAX_PACK_BYTES: Final = 16 * MIB
MAX_PACKS_OF_DISTRICT: Final = 256
MAX_DISTRICTS_OF_ARCHIVE: Final = 250_000
MAX_ARCHIVE_ROOT_BYTES: Final = 8 * MIB
MAX_DISTRICT_LIST_BYTES: Final = 2 * MIB
# Fields on the top level of a report: its tiles and its own, with room for a newer minor version's.
MAX_REPORT_FIELDS: Final = MAX_TILES_OF_DISTRICT + 64
# Fields on the top level of a reply about a district's tiles: five values a tile at most, with room.
MAX_TILES_REPLY_FIELDS: Final = 5 * MAX_TILES_OF_DISTRICT + 64
MAX_REMOVED_VOXELS: Final = 200_000
MAX_CODECS: Final = 16
MAX_REASON_CHARACTERS: Final = 1024
MAX_TEXT_CHARACTERS: Final = 128

# One tile's bitmap of observed voxels once unpacked: 1 M voxels, 690 floors of 39 x 39.
MAX_OBSERVED_BITMAP_BYTES: Final = 128 * KIB
# Observed voxels of a whole report once unpacked (32 MB of ids): many small bombs are a bomb.
MAX_OBSERVED_OF_REPORT: Final = 8 * MIB

# Flags of a packed report: each becomes a statement that is kept and merged.
MAX_FLAGS_OF_REPORT: Final = 256 * KIB
# Voxels of a report upon which its vehicle does not decide, and the sub-cells that one of them may count: more would
# have been a Gaussian.
MAX_UNSURE_OF_REPORT: Final = 64 * KIB
MAX_UNSURE_CELLS: Final = 19
# A report ends at most so long after it is received: the clocks of vehicles differ. Old ones are welcome.
MAX_AHEAD_NS: Final = 300_000_000_000
# Way of a packed report's track: the cloud looks along all of it.
MAX_WAY_OF_REPORT_M: Final = 3_000.0
# Bits of a mask in an ack, were it not compressed at all.
MAX_WANTED_BYTES: Final = MAX_FLAGS_OF_REPORT // 8 + KIB

# Reports of a vehicle that one question is about, and fields of the answer.
MAX_REPORTS_OF_QUESTION: Final = 64
MAX_STATES_OF_ACK: Final = 16

# Features of one tile, and points of one feature: a motorway's gantry has some twenty signs, a lane's piece some ten
# points a tile. A look is one camera image's or one scan's detections.
MAX_FEATURES_OF_TILE: Final = 4_096
MAX_POINTS_OF_FEATURE: Final = 4_096
MAX_DETECTIONS_OF_LOOK: Final = 1_024
MAX_SECTORS_OF_LOOK: Final = 4_096
# What a feature report holds over all its tiles: judged and found features, points of those found.
MAX_FEATURES_OF_REPORT: Final = 4_096
MAX_POINTS_OF_REPORT: Final = 32_768
# A feature lies in its tile, but for rounding and the error of who measured it.
MAX_FOUND_OUTSIDE_M: Final = 1.0
MAX_SEEN_OUTSIDE_M: Final = 100.0

# No Gaussian of the map lies outside: the Dead Sea's shore is at -430 m, Chomolungma at 8,849 m.
MIN_FLOOR: Final = -1_000
MAX_FLOOR: Final = 10_000

# Points inside a voxel of at most 1 m x 1 m x 1 m vary by at most (sqrt(3) / 2 m)^2 along any axis.
MAX_VARIANCE_M2: Final = 1.0

MAX_POSE_SIGMA_M: Final = 1_000.0
MAX_POSE_SIGMA_RAD: Final = 3.15

# A recorded drive: bytes of one unpacked chunk, points of one scan.
MAX_CHUNK_BYTES: Final = 256 * MIB
MAX_POINTS_OF_SCAN: Final = 4_000_000

# Bytes of one look, which are checked first; lane markings of a look and their points.
MAX_DETECTIONS_BYTES: Final = 128 * KIB
MAX_POLYLINES_OF_LOOK: Final = 64
MAX_POINTS_OF_LANE_LOOK: Final = 16_384
MAX_LANE_LOOK_BYTES: Final = 256 * KIB

# A part of a survey of a road that the map does not have: submaps of some twenty metres of way, what one of them holds,
# how far it reaches, and how many parts a survey has.
MAX_SUBMAPS_OF_SURVEY_PART: Final = 64
MAX_PARTS_OF_SURVEY: Final = 1_024
MAX_FIXES_OF_SURVEY_PART: Final = 1_024
MAX_TILES_OF_SUBMAP: Final = 64
MAX_GAUSSIANS_OF_SUBMAP: Final = 40_000
MAX_STEP_OF_SURVEY_M: Final = 100.0

# How a vehicle fares on tiles on trial: those around it, with room.
MAX_TILES_OF_HEALTH: Final = 256
MAX_HEALTH_REPORT_BYTES: Final = 16 * KIB
