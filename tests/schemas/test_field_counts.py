"""Fields that are too many are refused where they begin to be too many: the rest of a message is not walked through."""

from collections.abc import Callable

import pytest

from gnd.schemas.changes import ChangeReport
from gnd.schemas.errors import Malformed, TooLarge
from gnd.schemas.features import FeatureReport
from gnd.schemas.limits import MAX_REPORT_FIELDS
from gnd.schemas.survey import SurveyReport, is_survey
from gnd.schemas.tiles_batch import OTHERS_FIELD
from gnd.schemas.upload_head import head_of_upload
from gnd.schemas.wire_fields import submessages

READERS = (head_of_upload, is_survey, ChangeReport.decode, FeatureReport.decode, SurveyReport.decode)
JUNK = (b"\0\0", b"\xfa\x7f\0", b"\xf8\x7f\1")
"""Fields that hold nothing, of numbers that mean nothing; the first is of no number at all."""
NO_FIELD = b"\7"
"""At the end: who comes so far finds that the bytes are no fields."""


@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__qualname__)
@pytest.mark.parametrize("field", JUNK, ids=bytes.hex)
def test_nobody_walks_to_the_end_of_millions_of_fields(read: Callable[[bytes], object], field: bytes) -> None:
    with pytest.raises(TooLarge, match=f"more than {MAX_REPORT_FIELDS} fields"):
        read(field * 1_000_000 + NO_FIELD)
    with pytest.raises(TooLarge, match=f"more than {MAX_REPORT_FIELDS} fields"):
        read(field * (MAX_REPORT_FIELDS + 1))
    with pytest.raises(Malformed, match="wire type 7"):
        read(field * (MAX_REPORT_FIELDS - 1) + NO_FIELD)


def test_as_many_as_there_may_be_are_read() -> None:
    data = b"\x7a\0" * 9 + bytes([OTHERS_FIELD << 3 | 2, 1]) + b"x"
    assert list(submessages("TilesReply", data, OTHERS_FIELD, 10)) == [b"x"]
    with pytest.raises(TooLarge, match="TilesReply of 21 bytes has more than 9 fields"):
        list(submessages("TilesReply", data, OTHERS_FIELD, 9))
