"""Each long command ends on Ctrl-C and on SIGTERM in every phase, as `python -m studies endings` measures it."""

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait

import pytest

from studies.endings import AFTER_S, CASES, ENDS_IN_S, Ending, EndingCase, EndingWorld, ending_world, endings

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleets"), pytest.mark.timeout(900)]
AT_ONCE = 3
"""Commands side by side: each waits for most of its time. How soon they end alone, the study measures."""
ALONE = ("chaos",)
"""Has a dozen processes that need the cores: it begins when the others have ended."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EndingWorld]:
    with ending_world(tmp_path_factory.mktemp("endings")) as made:
        yield made


@pytest.fixture(scope="module")
def found(
    world: EndingWorld, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> Iterator[dict[str, Future[list[Ending]]]]:
    """The endings of each case that was asked for, by its name."""
    here = [item for item in request.session.items if item.path == request.path]
    cases = [item.callspec.params["case"] for item in here if isinstance(item, pytest.Function)]
    pool, begun = ThreadPoolExecutor(AT_ONCE), dict[str, Future[list[Ending]]]()

    def begin(case: EndingCase, before: tuple[Future[list[Ending]], ...] = ()) -> None:
        folder = tmp_path_factory.mktemp(case.name)
        begun[case.name] = pool.submit(lambda: (wait(before), endings(case, world, folder))[1])

    for case in sorted(filter(lambda one: one.is_possible, cases), key=lambda one: one.name in ALONE):
        begin(case, tuple(begun.values()) if case.name in ALONE else ())
    yield begun
    pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_command_ends_cleanly_on_either_signal_in_each_phase(
    case: EndingCase, found: dict[str, Future[list[Ending]]]
) -> None:
    if not case.is_possible:
        pytest.skip("needs root and iproute2")
    ends = found[case.name].result()
    assert len(ends) == 2 * len(AFTER_S)
    for one in ends:
        told = f"{case.name}, {one.signal.name} after {one.after_s:g} s: {one.wrong}\n{one.said}"
        assert one.wrong == [], told
        assert one.took_s < ENDS_IN_S, told
        if not one.by_itself and one.code in (130, 143):
            assert "interrupted" in one.said, told
