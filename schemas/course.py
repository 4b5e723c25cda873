"""Where a vehicle drives, seen in its own frame: what its LiDAR's mount is turned by against what it believes."""

from dataclasses import dataclass
from math import ceil
from typing import Final

from gnd.schemas.errors import BadValue
from gnd.schemas.generated import course_pb2

MAX_TURN_10URAD: Final = 314_160
_STEPS_PER_RAD: Final = 1e5


@dataclass(frozen=True, slots=True)
class Course:
    """The angle of the course to the vehicle's x axis, counter-clockwise seen from above, in the steps that it travels
    in.
    """

    turn_10urad: int
    sigma_10urad: int
    """Standard deviation, at least one step."""

    def __post_init__(self) -> None:
        if not -MAX_TURN_10URAD <= self.turn_10urad <= MAX_TURN_10URAD:
            raise BadValue(f"course turned by {self.turn_10urad} is outside ±{MAX_TURN_10URAD} steps of 10 µrad")
        if not 1 <= self.sigma_10urad <= MAX_TURN_10URAD:
            raise BadValue(f"sigma {self.sigma_10urad} of a course is outside 1 .. {MAX_TURN_10URAD} steps of 10 µrad")

    @classmethod
    def of(cls, turn_rad: float, sigma_rad: float) -> "Course":
        """The nearest step; the standard deviation rounded up, so that nothing is told surer than it is."""
        return cls(round(turn_rad * _STEPS_PER_RAD), max(1, ceil(sigma_rad * _STEPS_PER_RAD)))

    @property
    def turn_rad(self) -> float:
        """Counter-clockwise seen from above."""
        return self.turn_10urad / _STEPS_PER_RAD

    @property
    def sigma_rad(self) -> float:
        """Standard deviation."""
        return self.sigma_10urad / _STEPS_PER_RAD


def course_message(course: Course | None) -> course_pb2.Course | None:
    """The value as gnd.v1.Course."""
    if course is None:
        return None
    return course_pb2.Course(turn_10urad=course.turn_10urad, sigma_10urad=course.sigma_10urad)


def course_value(message: course_pb2.Course) -> Course:
    """The value of gnd.v1.Course; `BadValue` for what cannot be."""
    return Course(message.turn_10urad, message.sigma_10urad)
