"""The outcome of a run over hosts as tables."""

from typing import TYPE_CHECKING, Final

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from gnd.deploy.lab.hosts.verdict import HostsOutcome

_TIMES: Final = ("no ack for, s", "no tile for, s", "no new version for, s", "back after, s")


def print_hosts(console: Console, outcome: "HostsOutcome") -> None:
    """What ran where, what each fault cost, and what is left."""
    places = Table("host", "parts", title="what ran where")
    for name, parts in outcome.plan.items():
        places.add_row(name, ", ".join(parts) or "nothing")
    console.print(places)
    table = Table("fault", "hit", "lasted, s", "acks", *_TIMES, title="faults")
    calm = () if outcome.calm is None else (outcome.calm,)
    for trial in (*calm, *outcome.trials):
        told = trial.as_dict()
        times_s = (told["ack_gap_s"], told["tile_gap_s"], told["version_gap_s"], told["back_s"])
        gaps = ["" if one is None else f"{one:.2f}" for one in times_s]
        table.add_row(trial.fault, trial.where, f"{told['lasted_s']:.0f}", str(told["acknowledged"]), *gaps)
    console.print(table)
    if any(one.times > 1 for one in outcome.by_fault):
        console.print(_spreads(outcome))
    found = outcome.findings
    left = Table(title="what is left", show_header=False)
    rows = {
        "reports acknowledged": f"{found.acknowledged} of {found.reports}",
        "lost / doubled": f"{len(found.lost)} / {len(found.doubled)}",
        "versions merged / tiles stuck": f"{found.versions} / {len(found.stuck_tiles)}",
        **({"versions signed": str(found.signed)} if found.signed else {}),
        "map against its journal": "identical" if found.identical_map else f"NOT identical: {found.verify}",
        "settled after": "never" if outcome.settled_s is None else f"{outcome.settled_s:.1f} s",
    }
    for name, value in rows.items():
        left.add_row(name, value)
    console.print(left)


def _spreads(outcome: "HostsOutcome") -> Table:
    table = Table("fault", "times", *_TIMES, title="mean and worst")
    for one in outcome.by_fault:
        pairs = (one.ack_gap_s, one.tile_gap_s, one.version_gap_s, one.back_s)
        table.add_row(
            one.fault, str(one.times), *("" if pair is None else f"{pair[0]:.2f}, {pair[1]:.2f}" for pair in pairs)
        )
    return table


def hosts_verdict(outcome: "HostsOutcome") -> str:
    """One line."""
    begin = "interrupted: " if outcome.interrupted else ""
    return begin + ("; ".join(outcome.failures) if outcome.failures else "all guarantees were kept")
