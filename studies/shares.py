"""Districts over shards: the largest share against the mean, and what moves when a shard joins or leaves."""

from collections import Counter
from typing import Final

from gnd.cloud_merger.ownership import owner_of, shared_out
from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District, TileId
from studies.frame.measure import Figure

SHARDS: Final = (2, 4, 8, 16)
DISTRICTS: Final = (1000, 100, 20, 2)
NAMES: Final = 20
"""Sets of names for the shards: what hashes give depends on them."""
_FIRST: Final = District("13033/03021/00000").first_morton


def run() -> list[Figure]:
    """By number of districts and of shards, the worst of all sets of names."""
    return [figure for districts in DISTRICTS for n in SHARDS if n <= districts for figure in _figures(districts, n)]


def _figures(n_districts: int, n_shards: int) -> list[Figure]:
    districts = [TileId(_FIRST + k * TILES_OF_DISTRICT).district for k in range(n_districts)]
    shares, hashed, joined, left = [], [], [], []
    for names in range(NAMES):
        *shards, new = (f"shard-{names}-{k}" for k in range(n_shards + 1))
        owners = shared_out(districts, shards)
        shares.append(_share(list(owners.values()), n_shards))
        hashed.append(_share([owner_of(one, shards) for one in districts], n_shards))
        joined.append(_moved(owners, shared_out(districts, [*shards, new])) / (n_districts / (n_shards + 1)))
        gone = owners[districts[0]]
        stay = [one for one in shards if one != gone]
        left.append(_moved(owners, shared_out(districts, stay)) / Counter(owners.values())[gone])
    about = f"{n_districts} districts over {n_shards} shards"
    detail = f"the worst of {NAMES} sets of names; by hashes alone {max(hashed):.2f}"
    return [
        Figure(f"{about}: largest share of the mean", max(shares), "", detail),
        Figure(f"{about}: moves when one joins, of its mean", sum(joined) / NAMES, "", f"at most {max(joined):.2f}"),
        Figure(f"{about}: moves when one leaves, of what it had", sum(left) / NAMES, "", f"at most {max(left):.2f}"),
    ]


def _share(owners: list[str], n_shards: int) -> float:
    return max(Counter(owners).values()) * n_shards / len(owners)


def _moved(before: dict[District, str], after: dict[District, str]) -> int:
    return sum(before[one] != after[one] for one in before)
