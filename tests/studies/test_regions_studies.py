"""The studies of lost routers and of shares measure what they say."""

import pytest

from studies import router_loss, shares


def test_shares_stay_within_their_bound_where_hashes_do_not() -> None:
    share, joined, left = shares._figures(100, 8)
    assert share.value <= 13 * 8 / 100
    assert float(share.detail.rpartition(" ")[2]) > share.value
    assert 0 < joined.value < 8
    assert 1 <= left.value < 8


@pytest.mark.slow
def test_the_loss_of_a_router_is_measured_between_answers() -> None:
    (lost_s,) = router_loss._killed(router_loss.RouterLossOptions(kills=1))
    assert router_loss.ASK_EVERY_S < lost_s < router_loss.DEADLINE_S
