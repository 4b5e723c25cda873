"""A study's result as tables, for the terminal."""

from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

from studies.traffic_study.reference import PAPER_BYTES, PAPER_DRIVES, PAPER_KM

MAPS = (
    ("pcd", "PCD, 0.2 m"),
    ("pcd_compressed", "PCD compressed"),
    ("laz", "LAZ, 1 cm"),
    ("draco", "Draco, 12 bits"),
    ("gnd_protobuf", "GND, protobuf of doubles"),
    ("gnd_float", "GND, float32 columns"),
    ("gnd", "GND, standard"),
)
UPLOADS = (
    ("raw", "all measurements"),
    ("pcd_changes", "point-cloud changes"),
    ("gnd_float", "GND changes in floats"),
    ("gnd", "GND changes, flags first"),
)
STAGES = (("first", "first drive"), ("flags_first", "first 8 drives"), ("steady", "merged world"))


def tables_of(found: Mapping[str, Any]) -> list[Table]:
    """Return all tables."""
    return [_maps(found), _uploads(found), _rates(found), _codecs(found), _targets(found)]


def print_tables(tables: list[Table]) -> None:
    """Print them to standard output."""
    console = Console()
    for table in tables:
        console.print(table)


def _maps(found: Mapping[str, Any]) -> Table:
    down = found["download"]
    title = (
        f"download along {found['km']:.3f} km: {down['tiles']} tiles, {down['voxels']} voxels"
        f" ({down['voxels_per_km']} a km), {down['points']} points"
    )
    table = _table(title, "map", "MB", "MB/km", "B a voxel", "times GND", "paper, MB/km")
    for name, label in MAPS:
        size = down[name]["bytes"]
        if size is None:
            table.add_row(label, down[name]["missing"], "", "", "", "")
            continue
        ratio, paper = size / down["gnd"]["bytes"], PAPER_BYTES.get(f"download.{name}")
        shown = "" if paper is None else f"{paper / 1e6 / PAPER_KM:.2f}"
        row = (f"{size / 1e6:.3f}", f"{size / 1e6 / found['km']:.3f}", f"{size / down['voxels']:.2f}", f"{ratio:.1f}")
        table.add_row(label, *row, shown)
    return table


def _uploads(found: Mapping[str, Any]) -> Table:
    up = found["upload"]
    rate = up["changed_per_km"]["first"]
    title = f"upload: {up['drives']} drives of {found['km']:.3f} km; the first reports {rate:.0f} changes a km"
    table = _table(title, "what", "one, kB", "kB/km", "all, kB", "paper, kB/km", "of its fleet")
    for name, label in UPLOADS:
        one, fleet = up["single"][name]["bytes"], up["fleet"][name]["bytes"]
        table.add_row(label, _kb(one), _kb(one, found["km"]), _kb(fleet), _paper("single", name), _paper("fleet", name))
    return table


def _paper(stage: str, name: str) -> str:
    """What the paper's vehicles uploaded, a drive and km."""
    size = PAPER_BYTES.get(f"upload.{stage}.{name}")
    drives = PAPER_DRIVES if stage == "fleet" else 1
    return "" if size is None else f"{size / 1e3 / PAPER_KM / drives:.1f}"


def _kb(size: float | None, km: float = 1.0) -> str:
    return "" if size is None else f"{size / 1e3 / km:.2f}"


def _rates(found: Mapping[str, Any]) -> Table:
    up = found["upload"]
    table = _table("upload a km, by stage", "", *(label for _, label in STAGES))
    rows = {
        "kB/km up: keys and payloads": (up["kB_per_km"], 3),
        "kB/km with the transport": (up["wire_kB_per_km"], 3),
        "changes a km": (up["changed_per_km"], 0),
        "Gaussians asked for a km": (up["wanted_per_km"], 0),
    }
    for label, (values, digits) in rows.items():
        table.add_row(label, *(f"{values[stage]:.{digits}f}" for stage, _ in STAGES))
    parts = up["parts_bytes_per_km"]
    for part in parts["first"]:
        table.add_row(f"B/km: {part}", *(f"{parts[stage][part]:.0f}" for stage, _ in STAGES))
    return table


def _codecs(found: Mapping[str, Any]) -> Table:
    title = "codecs on this street"
    table = _table(title, "lattice", "B a voxel", "zstd, B", "KL, nats", "pose shift, cm", "encode, ms", "decode, ms")
    codecs = {"archive": found["codec"]["archive"], "standard": found["codec"], "compact": found["codec"]["compact"]}
    for name, one in codecs.items():
        table.add_row(
            name,
            f"{one['bytes_per_voxel']:.3f}",
            f"{one['zstd_bytes_per_voxel']:.3f}",
            f"{one['kl_median']:.4f}",
            f"{one['pose_shift_cm_median']:.3f}",
            f"{one['encode_ms']:.2f}",
            f"{one['decode_ms']:.2f}",
        )
    return table


def _targets(found: Mapping[str, Any]) -> Table:
    f1 = found["f1"]
    lost = (
        ""
        if f1["float"] is None
        else f"; F1 after {f1['drives']} drives {f1['codec']:.2f}, in floats {f1['float']:.2f}"
    )
    density = found["upload"]["changed_per_km"]["first"]
    title = f"targets, at {found['download']['voxels_per_km']} voxels and {density:.0f} changes a km{lost}"
    table = _table(title, "row", "ours", "paper", "must", "aim", "met")
    for name, row in found["targets"].items():
        sign = "≥" if row["larger_is_better"] else "≤"
        met = "aim" if row["aim_met"] else "yes" if row["met"] else "NO"
        limits = (f"{sign} {row['must']:g}", f"{sign} {row['aim']:g}")
        table.add_row(name, f"{row['value']:.3f} {row['unit']}", row["paper"], *limits, met)
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table
