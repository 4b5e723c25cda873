"""Where a vehicle drives in its own frame: in steps, never surer than it is, refused where it cannot be."""

from math import radians

import pytest
from schema_values import GOLDEN, report

from gnd.schemas.changes import ChangeReport, split
from gnd.schemas.course import Course
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import change_report_pb2


def test_a_course_is_rounded_and_its_sigma_rounded_up() -> None:
    course = Course.of(radians(0.5), 1.2e-5)
    assert (course.turn_10urad, course.sigma_10urad) == (873, 2)
    assert course.turn_rad == pytest.approx(radians(0.5), abs=5e-6)
    assert Course.of(0.0, 0.0) == Course(0, 1)


@pytest.mark.parametrize(
    ("values", "reason"), [((314_161, 1), "turned by 314161"), ((0, 0), "sigma 0 of a course"), ((0, 314_161), "sigma")]
)
def test_courses_that_cannot_be_are_refused(values: tuple[int, int], reason: str) -> None:
    with pytest.raises(BadValue, match=reason):
        Course(*values)


def test_each_tile_of_a_split_report_keeps_the_course() -> None:
    whole = report(course=Course(-910, 12))
    assert {ChangeReport.decode(body).course for _, body in split(whole)} == {whole.course}


def test_bytes_of_a_course_that_cannot_be_are_refused() -> None:
    message = change_report_pb2.ChangeReport.FromString(GOLDEN["ChangeReport-course"].encode())
    message.course.sigma_10urad = 0
    with pytest.raises(BadValue, match="sigma 0"):
        ChangeReport.decode(message.SerializeToString())
