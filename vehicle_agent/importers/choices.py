"""What whoever imports a recording may decide instead of the reader: options as text, and what they mean."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.fields import ANY_FIELD, UNITS_NS, FieldChoice
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.importers.rigid import orthonormal

F64 = NDArray[np.float64]

METRES_OF: Final = {"m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0, "cm": 0.01, "mm": 0.001}
"""Units of coordinates; the foot of US surveys differs from the international one by 2 ppm, 1 m at 500 km."""
PosesOf = Literal["vehicle", "lidar"]


@dataclass(frozen=True, slots=True, eq=False)
class Choices:
    """Decisions about a recording; what is left as it is, the reader decides.

    anchor: place on the Earth. topic: of the clouds. poses: file or topic with the track; poses_frame and poses_of:
    what its coordinates count from and whose poses they are. mount: (4, 4) T_vehicle_lidar. sensor: model name.
    fields: which field is a point's time. unit: of coordinates. strict: the first bad file ends the import. nowhere: a
    recording without a place becomes a drive that is marked so. stand_ins: fixes and motion are computed from the
    poses where the recording has none.
    """

    anchor: RecordingAnchor | None = None
    topic: str | None = None
    poses: str | None = None
    poses_frame: str = "auto"
    poses_of: PosesOf | None = None
    mount: F64 | None = None
    sensor: str | None = None
    fields: FieldChoice = ANY_FIELD
    unit: str = "m"
    strict: bool = False
    nowhere: bool = False
    stand_ins: bool = False

    @property
    def files(self) -> tuple[Path, ...]:
        """What may be files among the choices."""
        return tuple(Path(one) for one in (self.poses, self.sensor) if one)

    def __post_init__(self) -> None:
        if self.unit not in METRES_OF:
            raise ImportDriveError(f"--units {self.unit}: known are {', '.join(METRES_OF)}")
        if self.poses_of is not None and self.poses_of not in get_args(PosesOf):
            raise ImportDriveError(f"--poses-of {self.poses_of}: known are {', '.join(get_args(PosesOf))}")
        if self.nowhere and self.anchor is not None:
            raise ImportDriveError("--nowhere and --anchor: a drive has a place or has none")


def anchor_of_text(text: str) -> RecordingAnchor:
    """The place LAT,LON,HEIGHT[,HEADING]: degrees, metres above the ellipsoid, degrees clockwise from north.

    Raises:
        ImportDriveError: other than three or four numbers, or no place on the Earth.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (3, 4) or not np.isfinite(values).all():
        raise ImportDriveError(f"--anchor {text!r}: expected LAT,LON,HEIGHT or LAT,LON,HEIGHT,HEADING: 37.56,127.03,30")
    if not (-90.0 <= values[0] <= 90.0 and -180.0 <= values[1] <= 180.0):
        raise ImportDriveError(f"--anchor {text!r}: latitude -90 ... 90 and longitude -180 ... 180 degrees are needed")
    return RecordingAnchor(*values)


def mount_of_text(text: str) -> F64:
    """(4, 4) T_vehicle_lidar of X,Y,Z,ROLL,PITCH,YAW (`mount_of_numbers`), or of a file with 12 or 16 numbers.

    Raises:
        ImportDriveError: neither, or a matrix that is no rotation.
    """
    path = Path(text)
    words = path.read_text(errors="replace").split() if path.is_file() else text.split(",")
    try:
        values = np.array([float(word) for word in words], np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) == 6 and not path.is_file():
        return mount_of_numbers(values)
    if len(values) in (12, 16) and path.is_file():
        T, _ = orthonormal(values.reshape(-1, 4)[None, :3], f"--mount {text}")
        return np.asarray(T[0])
    raise ImportDriveError(
        f"--mount {text!r}: expected X,Y,Z,ROLL,PITCH,YAW in metres and degrees, such as 1.2,0,1.9,0,0,0, or a file"
        " with the 12 or 16 numbers of T_vehicle_lidar"
    )


def mount_of_numbers(values: Sequence[float] | F64) -> F64:
    """(4, 4) T_vehicle_lidar of x, y, z in m and roll, pitch, yaw in degrees.

    The rotation is R_z(yaw) R_y(pitch) R_x(roll), as in ROS.
    """
    roll, pitch, yaw = np.radians(values[3:])
    R = exp_so3([0.0, 0.0, yaw]) @ exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0])
    return T_from_R_t(R, values[:3])


def fields_of_text(text: str) -> FieldChoice:
    """NAME, NAME:UNIT (s, ms, us, ns) or `none`, of the field that is a point's time."""
    name, _, unit = text.partition(":")
    if unit and unit not in UNITS_NS:
        raise ImportDriveError(f"--time-field {text!r}: unit {unit}; known are {', '.join(UNITS_NS)}")
    return FieldChoice(name, unit or None)
