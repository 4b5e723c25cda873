"""`docs/scale.md`: tables from the committed measurements, the model and the prices."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from typing import Final

from studies.scale.fit import FittedStore, Foretold, fitted_stores, foretold
from studies.scale.loads import KINDS, Kind, Loads
from studies.scale.model import CpuCosts
from studies.scale.plan import (
    CostsOfUse,
    MeasuredFigure,
    PlannedPlace,
    ScaleParameters,
    limits,
    measured_figures,
    planned,
)
from studies.scale.region import ReportShape, costs_of_use, light, regions, shards_of_region

MUST: Final = 0.25
AIM: Final = 0.10
USES: Final = ("compared", "unseen")
SHARES: Final = (0.3, 0.6, 0.9, 1.2)
PUBLISHED: Final = "postgresql: 4 tiles published together"
MILLION: Final = (
    ("get a tile, p50", "ms"),
    ("get a tile, p99", "ms (must 5)"),
    ("region of 1024 tiles, p50", "ms (must 100)"),
    ("region of 1024 tiles, CPU", "ms"),
    ("catalog of a district, p50", "ms (must 10)"),
    ("catalog of a district, CPU", "ms"),
    ("question about 8 tiles that are held, CPU", "ms"),
    ("on the disk", "B a tile"),
)
EASY_SHARE: Final = 0.85
"""Of a core: what takes more has to wait for it."""
Row = tuple[object, ...]


def page() -> str:
    """The document; the same whenever the same is committed."""
    loads, figures, given = Loads.read(), measured_figures(), ScaleParameters.read()
    fitted = fitted_stores(loads)
    told = [foretold(load, loads, fitted[kind]) for use in USES for kind in KINDS for load in loads.of(kind, use)]
    of_region = replace(fitted["postgresql"].costs, publish_s=figures[PUBLISHED].value / 4e3, begin_s=0.0)
    shape = ReportShape.of(figures, loads.worker.again["settled"])
    use = costs_of_use(of_region, figures, light(of_region, shape))
    places = [planned(place, use, given) for place in given.place]
    values = {
        "costs": _costs(fitted),
        "compared": _compared(told, loads),
        "reached": _reached(told),
        "spread": _spread(told, loads),
        "use": _use(use),
        "places": _places(places),
        "money": _money(places, given),
        "limits": _limits(use, given),
        "regions": _regions(of_region, shape, use),
        "n_regions": _two(places[1].databases),
        "shards": str(shards_of_region(use)),
        "million": _million(figures),
        "figures": _figures(figures),
        "machine": loads.machine,
        "runs": _ends([loads.runs(one.load) for one in told]),
        "given": _given(given),
        "beside": f"{fitted['file'].beside:.2f}",
        "unit": f"{fitted['file'].unit_ms:.1f}",
        "units": _ends([one.unit_ms for one in loads.loads]),
        "again": " and ".join(f"{share:.2f} on {name} streets" for name, share in loads.worker.again.items()),
    }
    text = resources.files(__package__).joinpath("page.md").read_text(encoding="utf-8")
    for name, value in values.items():
        text = text.replace("{{" + name + "}}", value)
    return text


def _table(head: Row, rows: Iterable[Row]) -> str:
    lines = [head, ("---",) + ("---:",) * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def _two(value: float) -> str:
    """Two figures, which is more than is known."""
    if value == 0:
        return "0"
    rounded = float(f"{value:.2g}")
    return f"{rounded:,.0f}" if abs(rounded) >= 10 else f"{rounded:g}"


def _ends(values: Sequence[float]) -> str:
    least, most = min(values), max(values)
    return f"{least:.3g}" if least == most else f"{least:.3g} to {most:.3g}"


def _percent(share: float) -> str:
    return f"{100 * share:+.0f} %"


def _costs(fitted: Mapping[Kind, FittedStore]) -> str:
    rows: dict[str, list[str]] = {}
    for one in (fitted[kind].costs for kind in KINDS):
        for name, value in (
            ("an upload received, ms (clients included)", 1e3 * one.receive_s),
            ("flags, ms a tile", 1e3 * one.flags_s),
            ("second half, ms", 1e3 * one.half_s),
            ("merge of a tile, ms", 1e3 * one.merge_s),
            ("a worker, once, ms", 1e3 * one.begin_s),
            ("of a merge after its publication, %", 100 * one.notice_share),
            ("of all in the database server, %", 100 * one.database_share),
            ("of n reports about a tile the next is news with 1 / (1 + n / …)", one.news),
        ):
            rows.setdefault(name, []).append(_two(value))
    return _table(("", *KINDS), [(name, *values) for name, values in rows.items()])


def _compared(told: list[Foretold], loads: Loads) -> str:
    rows = []
    for one in told:
        load, errors = one.load, one.errors()
        rows.append(
            (
                load.store + (" (unseen)" if load.setting.use == "unseen" else ""),
                f"{load.setting.vehicles}, {load.setting.changed_share:g}, {load.setting.shards}",
                loads.runs(load),
                f"{100 * load.core_share:.0f} %",
                f"{load.reports_per_s:.1f} / {one.reports_per_s:.1f} ({_percent(errors['throughput'])})",
                *(f"{load.lag_s[q]:.2f} / {one.lag_s[q]:.2f} ({_percent(errors[f'lag {q}'])})" for q in ("p50", "p95")),
            )
        )
    head = (
        "store", "vehicles, changed streets, shards", "runs", "CPU, of a core", "reports a second: measured / model",
        "lag p50, s", "lag p95, s",
    )  # fmt: skip
    return _table(head, rows)


def _reached(told: list[Foretold]) -> str:
    rows = []
    kinds = (
        ("", told),
        (f", below {100 * EASY_SHARE:.0f} % of the core", [one for one in told if one.load.core_share < EASY_SHARE]),
        (", beyond", [one for one in told if one.load.core_share >= EASY_SHARE]),
        (", of the unseen", [one for one in told if one.load.setting.use == "unseen"]),
    )
    for what in ("throughput", "lag p50", "lag p95"):
        for kind, some in kinds:
            errors = [abs(one.errors()[what]) for one in some]
            mean, worst = sum(errors) / len(errors), max(errors)
            verdict = "aim met" if worst <= AIM else "must met" if worst <= MUST else "missed"
            within = sum(error <= MUST for error in errors)
            of_all = f"{within} of {len(errors)}"
            rows.append((what + kind, f"{100 * mean:.0f} %", f"{100 * worst:.0f} %", of_all, verdict))
    return _table(("error of the model", "mean", "worst", "within 25 %", ""), rows)


def _spread(told: list[Foretold], loads: Loads) -> str:
    """How far runs of one setting lie apart, the most of all settings."""
    apart = {"throughput": 0.0, "lag p50": 0.0, "lag p95": 0.0}
    for one in told:
        runs = [it for it in loads.loads if (it.setting, it.store) == (one.load.setting, one.load.store)]
        for what, values in (
            ("throughput", [it.reports_per_s for it in runs]),
            ("lag p50", [it.lag_s["p50"] for it in runs]),
            ("lag p95", [it.lag_s["p95"] for it in runs]),
        ):
            apart[what] = max(apart[what], max(values) / min(values) - 1.0)
    return ", ".join(f"{_percent(share)} ({what})" for what, share in apart.items())


def _use(use: CostsOfUse) -> str:
    rows = [
        ("reports a km", _two(use.reports_a_km)),
        ("CPU of a report with its merges, router, receivers and workers", f"{_two(1e3 * use.worker_s)} ms"),
        ("the same, database", f"{_two(1e3 * use.database_s)} ms"),
        ("merges a report", _two(use.merges)),
        ("of a merge, for which the database is its own", f"{_two(1e3 * use.publish_s)} ms"),
        ("questions whether the map still holds, a km", _two(use.questions_a_km)),
        ("CPU of one", f"{_two(1e3 * use.question_s)} ms"),
        ("on the wire up; down, a km", f"{_two(use.up_bytes_a_km / 1e3)}; {_two(use.down_bytes_a_km / 1e3)} kB"),
        ("a km of road: tiles; bodies", f"{_two(use.tiles_a_km)}; {_two(use.map_bytes_a_km / 1e3)} kB"),
        ("a report in the journal, bodies of its tiles", f"{_two(use.journal_bytes / 1e3)} kB"),
        ("a stored tile beside its body", f"{_two(use.tile_row_bytes)} B"),
    ]  # fmt: skip
    return _table(("", "measured or simulated"), rows)


def _places(places: list[PlannedPlace]) -> str:
    rows: list[Row] = [
        ("vehicles", *(f"{one.place.vehicles:,.0f}" for one in places)),
        ("road, km", *(f"{one.place.road_km:,.0f}" for one in places)),
    ]
    for name, of in (
        ("vehicles on the road at the peak (sessions)", "on_road"),
        ("reports a second at the peak", "reports_s"),
        ("merges a second at the peak", "merges_s"),
        ("questions about tiles a second at the peak", "questions_s"),
        ("cores of shards (as many shards)", "shard_cores"),
        ("cores of databases", "database_cores"),
        ("cores of tile servers", "tile_cores"),
        ("databases", "databases"),
        ("routers, by sessions", "routers"),
        ("bodies of tiles, GB", "bodies_gb"),
        ("rows of tiles, GB, one copy", "rows_gb"),
        ("journal with its open windows, GB, one copy", "journal_gb"),
        ("up at the peak, Gbit/s", "up_gbit_s"),
        ("down at the peak, Gbit/s", "down_gbit_s"),
        ("egress, GB a year", "egress_gb"),
    ):
        rows.append((name, *(_two(getattr(one, of)) for one in places)))
    return _table(("", *(one.place.name for one in places)), rows)


def _money(places: list[PlannedPlace], given: ScaleParameters) -> str:
    rows: list[Row] = [(part, *(_two(one.money[part]) for one in places)) for part in places[0].money]
    sums = [sum(one.money.values()) for one in places]
    rows.append(("**all**", *(f"**{_two(one)}**" for one in sums)))
    rows.append(("a vehicle", *(_two(total / one.place.vehicles) for total, one in zip(sums, places, strict=True))))
    return _table((f"{given.prices.currency} a year", *(one.place.name for one in places)), rows)


def _limits(use: CostsOfUse, given: ScaleParameters) -> str:
    rows = [(one.what, _two(one.vehicles), one.then) for one in limits(use, given)]
    return _table(("what ends", "at vehicles", "what takes over"), rows)


def _regions(costs: CpuCosts, shape: ReportShape, use: CostsOfUse) -> str:
    rows = [
        (
            f"{100 * one.share:.0f} %",
            _two(one.offered_per_s),
            _two(one.done_per_s),
            _two(one.ack_ms_p50),
            *map(_two, one.lag_s),
        )
        for one in regions(costs, shape, use, SHARES)
    ]
    return _table(
        (
            "of what publications can take",
            "reports a second",
            "done a second",
            "ack p50, ms",
            "lag p50, s",
            "lag p95, s",
        ),
        rows,
    )


def _million(figures: Mapping[str, MeasuredFigure]) -> str:
    rows = [(f"{name}, {unit}", *(_two(figures[f"{kind}: {name}"].value) for kind in KINDS)) for name, unit in MILLION]
    return _table(("", *KINDS), rows)


def _figures(figures: Mapping[str, MeasuredFigure]) -> str:
    commands: dict[tuple[str, str, str], list[str]] = {}
    for name, one in figures.items():
        commands.setdefault((one.command, one.at, one.machine), []).append(name)
    return "\n".join(
        f"- `{command}` ({at}; {machine}): {len(names)} figure{'s' * (len(names) > 1)}"
        for (command, at, machine), names in commands.items()
    )


def _given(given: ScaleParameters) -> str:
    driving, keeping, prices = given.driving, given.keeping, given.prices
    rows: list[Row] = [
        ("km a vehicle and year", f"{driving.km_a_year:,.0f}", driving.km_source),
        ("peak to mean", f"{driving.peak_to_mean:g}", driving.peak_source),
        ("speed, km/h", f"{driving.speed_kmh:g}", driving.speed_source),
        ("share of km on roads that the cache does not hold", f"{driving.new_road_share:g}", driving.new_road_source),
        ("use of a core at the peak", f"{keeping.use_of_a_core:g}", keeping.source),
        ("days in the journal", f"{keeping.journal_days:g}", keeping.source),
        ("versions kept of a tile", f"{keeping.versions_kept:g}", keeping.source),
        ("copies of a database", f"{keeping.copies:g}", keeping.source),
        (f"core, {prices.currency} an hour", f"{prices.core_hour:g}", prices.core_source),
        (f"objects, {prices.currency} a GB and month", f"{prices.object_gb_month:g}", prices.object_source),
        (f"disk, {prices.currency} a GB and month", f"{prices.disk_gb_month:g}", prices.disk_source),
        (f"egress, {prices.currency} a GB", f"{prices.egress_gb:g}", prices.egress_source),
    ]  # fmt: skip
    lines = _table(("given", "value", "source"), rows).split("\n")
    return "\n".join([lines[0], "|---|---:|---|", *lines[2:]])
