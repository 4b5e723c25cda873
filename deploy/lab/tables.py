"""The tables of `gnd lab` and `gnd lab check` for people."""

from typing import Any

from rich.table import Table

from gnd.deploy.lab.check import LinkMeasured


def rate_text(bit_s: float | None) -> str:
    """Return a rate for people: 1.90, 153, "no limit"."""
    if bit_s is None or bit_s == float("inf"):
        return "no limit"
    mbit_s = bit_s / 1e6
    return f"{mbit_s:.0f}" if mbit_s >= 100 else f"{mbit_s:.2f}"


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for number, name in enumerate(columns):
        table.add_column(name, justify="left" if number < 2 else "right")
    return table


def check_table(measured: list[LinkMeasured]) -> Table:
    """Return wanted and measured rate, delay and loss of each direction."""
    table = _table(
        "link", "", "rate Mbit/s", "flood", "one TCP", "sent again",
        "delay ms", "5 %", "50 %", "95 %", "loss", "measured",
    )  # fmt: skip
    for one in measured:
        table.add_row(
            one.profile,
            one.direction,
            rate_text(one.wanted_bit_s),
            rate_text(one.rate_bit_s),
            rate_text(one.tcp.bit_s),
            f"{one.tcp.resent:.2%}",
            f"{one.wanted_delay_ms:.1f} ± {one.wanted_jitter_ms:.1f}",
            *(f"{delay_ms:.1f}" for delay_ms in one.stream.delay_ms),
            f"{one.wanted_loss:.2%}",
            f"{one.stream.loss:.2%} of {one.stream.sent}",
        )
    return table


def run_table(report: dict[str, Any]) -> Table:
    """Return the account of a run in a lab (`report.as_json`), two lines a group."""
    table = _table(
        "group", "", "vehicles", "rate Mbit/s", "peak 1 s", "delay ms", "round trip", "loss", "lost", "overflowed",
        "interface B", "ledger B", "differ", "worst",
    )  # fmt: skip
    for group in report["groups"]:
        for direction in ("down", "up"):
            table.add_row(*_run_row(group, direction, group[direction]))
    return table


def _run_row(group: dict[str, Any], direction: str, values: dict[str, Any]) -> tuple[str, ...]:
    return (
        group["group"],
        direction,
        str(group["vehicles"]),
        rate_text(values["rate_bit_s"]),
        rate_text(values["peak_bit_s"]),
        _wanted_and_got(group["wanted_delay_ms"], values["delay_ms"]),
        _wanted_and_got(2 * group["wanted_delay_ms"], group["round_trip_ms"]),
        f"{group['wanted_loss']:.2%}",
        f"{values['loss']:.2%} ({values['lost']})",
        str(values["overflowed"]),
        f"{values['interface_bytes']}",
        f"{values['ledger_bytes']}",
        f"{values['difference']:+.2%}",
        f"{values['worst_difference']:+.2%}",
    )


def _wanted_and_got(wanted: float, got: float | None) -> str:
    return f"{wanted:.1f} → {got:.1f}" if got is not None else f"{wanted:.1f} → ?"


def run_verdict(report: dict[str, Any]) -> str:
    """Return one line: whether ledger and interfaces agree."""
    bad = [
        f"{group['group']} {direction}"
        for group in report["groups"]
        for direction in ("down", "up")
        if not group[direction]["agrees"]
    ]
    limit = f"{report['tolerance'] * 100:.0f} %"
    if bad:
        return f"ledger and interface counters differ by more than {limit}: {', '.join(bad)}"
    return f"ledger and interface counters agree within {limit} in every namespace"
