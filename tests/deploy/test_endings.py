"""Each long command ends on Ctrl-C and on SIGTERM in every phase, as `python -m studies endings` measures it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from studies.endings import AFTER_S, CASES, ENDS_IN_S, EndingCase, EndingWorld, ending_world, endings

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleets"), pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EndingWorld]:
    with ending_world(tmp_path_factory.mktemp("endings")) as made:
        yield made


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_command_ends_cleanly_on_either_signal_in_each_phase(
    case: EndingCase, world: EndingWorld, tmp_path: Path
) -> None:
    if not case.is_possible:
        pytest.skip("needs root and iproute2")
    found = endings(case, world, tmp_path)
    assert len(found) == 2 * len(AFTER_S)
    for one in found:
        told = f"{case.name}, {one.signal.name} after {one.after_s:g} s: {one.wrong}\n{one.said}"
        assert one.wrong == [], told
        assert one.took_s < ENDS_IN_S, told
        if not one.by_itself and one.code in (130, 143):
            assert "interrupted" in one.said, told
