"""Loads are compared only where a shard is offered the same in each; districts are shared out as shards do it."""

from collections import Counter

import pytest

from gnd.gnd_map.tile_id import District
from studies.frame.errors import OptionError
from studies.scale.loads import LoadSetting
from studies.scale.mix import OfferedMix, owners_of
from studies.scale.rates import MOST_APART, require_alike

ONE, FOUR = (LoadSetting("compared", vehicles=8 * shards, changed_share=0.5, shards=shards) for shards in (1, 4))


def test_loads_that_offer_the_same_are_compared(capsys):
    require_alike({ONE: OfferedMix(68, 0.56, 4.0, 1.0), FOUR: OfferedMix(273, 0.56, 4.0, 1.08)})
    assert capsys.readouterr().out.count("are offered") == 2


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (OfferedMix(297, 0.42 + 2 * MOST_APART, 4.0, 1.0), "changed: 0.42, 0.52"),
        (OfferedMix(297, 0.42, 10 / 3, 1.0), "a_street: 4.00, 3.33"),
    ],
)
def test_loads_that_do_not_are_refused_with_what_differs(other, what):
    with pytest.raises(OptionError, match=what):
        require_alike({ONE: OfferedMix(74, 0.42, 4.0, 1.0), FOUR: other})


def test_each_copy_of_a_district_has_an_owner_and_no_shard_has_more_than_its_share():
    street = {District("13033/03021/23030"), District("13033/03021/23031")}
    owners = owners_of(street, [0, 3, 6, 9, 12, 15, 18, 21], 4)
    assert Counter(owners.values()) == {0: 4, 1: 4, 2: 4, 3: 4}
    assert street < set(owners)
