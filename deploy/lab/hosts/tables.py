"""The outcome of a run over hosts as tables."""

from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from gnd.deploy.lab.hosts.verdict import HostsOutcome


def print_hosts(console: Console, outcome: "HostsOutcome") -> None:
    """What ran where, what each fault cost, and what is left."""
    places = Table("host", "parts", title="what ran where")
    for name, parts in outcome.plan.items():
        places.add_row(name, ", ".join(parts) or "nothing")
    console.print(places)
    table = Table(
        "fault", "hit", "lasted, s", "acks", "no ack for, s", "no tile for, s", "back after, s", title="faults"
    )
    calm = () if outcome.calm is None else (outcome.calm,)
    for trial in (*calm, *outcome.trials):
        told = trial.as_dict()
        times_s = (told["ack_gap_s"], told["tile_gap_s"], told["back_s"])
        gaps = ["" if one is None else f"{one:.2f}" for one in times_s]
        table.add_row(trial.fault, trial.where, f"{told['lasted_s']:.0f}", str(told["acknowledged"]), *gaps)
    console.print(table)
    found = outcome.findings
    left = Table(title="what is left", show_header=False)
    rows = {
        "reports acknowledged": f"{found.acknowledged} of {found.reports}",
        "lost / doubled": f"{len(found.lost)} / {len(found.doubled)}",
        "versions merged / tiles stuck": f"{found.versions} / {len(found.stuck_tiles)}",
        "map against its journal": "identical" if found.identical_map else f"NOT identical: {found.verify}",
        "settled after": "never" if outcome.settled_s is None else f"{outcome.settled_s:.1f} s",
    }
    for name, value in rows.items():
        left.add_row(name, value)
    console.print(left)


def hosts_verdict(outcome: "HostsOutcome") -> str:
    """One line."""
    begin = "interrupted: " if outcome.interrupted else ""
    return begin + ("; ".join(outcome.failures) if outcome.failures else "all guarantees were kept")
