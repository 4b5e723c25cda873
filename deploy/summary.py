"""The result of a run: `summary.json`, three pictures, the traffic page, and a few lines for people."""

import json
from pathlib import Path
from typing import Any

from gnd.deploy.account import FleetResults, TileHistory, account_traffic, lost_reports, tile_histories
from gnd.deploy.evaluation import NO_TRUTH, score_run
from gnd.deploy.features import feature_lines, score_layers
from gnd.deploy.fleet import FleetOutcome, count_lines
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.learning import account_learning, learning_lines
from gnd.deploy.live_traffic import traffic_lines
from gnd.deploy.made_up import made_up_lines, score_made_up
from gnd.deploy.prepare import PreparedRun
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_sim.ellipsoids import Tiles, ellipsoids_of_maps
from gnd.fleet_sim.pictures import StreetView, draw_healing, draw_map, draw_run
from gnd.fleet_sim.truth import Truth, read_truth
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.settings import settings_sha256
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.status import named_vehicles, waiting_totals
from gnd.words import many


def write_summary(
    config: FleetConfig, folder: RunFolder, prepared: PreparedRun, outcome: FleetOutcome, prepare_s: float
) -> dict[str, Any]:
    """Account for a finished run, compare it with the truth where there is one, and write `summary.json`.

    Args:
        config: what was run.
        folder: the run.
        prepared: drives and truth.
        outcome: time and restarts.
        prepare_s: how long world, drives and base map took before.

    Returns:
        The content of `summary.json`.
    """
    results = FleetResults.read(folder)
    with SqliteStore(folder.store) as store:
        histories = tile_histories(store)
        summary = _counts(config, folder, prepared, outcome, results, store, histories)
        truth = read_truth(prepared.truth) if prepared.truth is not None else None
        summary["f1"] = _evaluate(folder, truth, store, histories)
        summary["learning"] = account_learning(folder, store, truth, {h.tile.tile: h.before for h in histories})
        summary["waiting_for_confirmation"] = waiting_totals(store)
        summary["named_vehicles"] = named_vehicles(store)
        summary["made_up"] = score_made_up(prepared.made_up, histories)
        summary["features"] = _score_features(config, prepared, store)
    summary["prepare_s"] = round(prepare_s, 1)
    summary["doubtful"] = doubtful_vehicles(results)
    summary["localisation_p95"] = results.localisation_p95()
    summary["traffic"] = account_traffic(folder)
    summary["settings_sha256"] = settings_sha256(config)
    _write(folder.summary, summary)
    return summary


def doubtful_vehicles(results: FleetResults) -> dict[str, Any]:
    """What each vehicle took back, held back or doubted, by its name; nothing of those that did not."""
    named = ("scans_shifted", "scans_taken_back", "tiles_doubtful", "tiles_held_back", "changes_held_back")
    found = {r["vehicle"]: {name: r.get(name, 0) for name in named} | r.get("doubts", {}) for r in results.results}
    return {vehicle: counts for vehicle, counts in found.items() if any(counts[name] for name in named)}


def _counts(
    config: FleetConfig,
    folder: RunFolder,
    prepared: PreparedRun,
    outcome: FleetOutcome,
    results: FleetResults,
    store: SqlStore,
    histories: list[TileHistory],
) -> dict[str, Any]:
    return {
        "agents": len(prepared.agent_drives),
        "shards": config.shards,
        "link": config.link,
        "world_seed": config.world_seed if prepared.truth else None,
        "wall_s": round(outcome.wall_s, 1),
        "drive_km": round(results.total("distance_km"), 4),
        "tiles_downloaded": int(results.total("tiles_downloaded")),
        "reports_sent": int(results.total("reports_sent")),
        "reports_acknowledged": int(results.total("reports_acknowledged")),
        "reports_quarantined": int(results.total("reports_quarantined")),
        "reports_lost": len(lost_reports(folder, store, config.layers)),
        "tiles_published": outcome.published,
        "updates_received": count_lines(folder.updates),
        "changed_voxels": sum(history.changed_voxels() for history in histories),
        "agent_pss_mb_max": max((result["memory_mb"]["pss_peak"] for result in results.results), default=None),
        "restarts": outcome.restarts,
    }


def _evaluate(folder: RunFolder, truth: Truth | None, store: SqlStore, histories: list[TileHistory]) -> dict[str, Any]:
    """Compare with the truth where there is one; draw the maps in any case."""
    base = {history.tile.tile: history.before for history in histories}
    final = {history.tile.tile: history.after for history in histories}
    if truth is None:
        _draw_maps(folder, base, final)
        return dict(NO_TRUTH)
    draw_run(truth, base, final, folder.root)
    draw_healing(truth, base, final, folder.root / "healing.png")
    return score_run(truth, store, histories).as_dict()


def _score_features(config: FleetConfig, prepared: PreparedRun, store: SqlStore) -> dict[str, Any]:
    """Compare feature layers with the truth where there is one."""
    if prepared.world is None or not config.feature_layers:
        return {}
    return score_layers(prepared.world, store, config.feature_layers)


def _draw_maps(folder: RunFolder, base: Tiles, final: Tiles) -> None:
    if not final:
        return
    frame = LocalFrame.of_tile(sorted(final)[len(final) // 2])
    after = ellipsoids_of_maps(frame, base, final)
    view = StreetView.around(after)
    draw_map(ellipsoids_of_maps(frame, base), folder.root / "map_before.png", "Map before", "", view)
    draw_map(after, folder.root / "map_after.png", "Map after", "coloured by what the fleet changed", view)


def _write(path: Path, summary: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    partial.replace(path)


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """Return a summary as lines for people."""
    traffic, f1, p95, waiting = (
        summary["traffic"],
        summary["f1"],
        summary["localisation_p95"],
        summary["waiting_for_confirmation"],
    )
    lines = [
        f"{many(summary['agents'], 'agent')} drove {summary['drive_km']:.2f} km on {_links_text(summary['link'])} in"
        f" {summary['wall_s']:.0f} s; {many(summary['tiles_downloaded'], 'tile')} downloaded",
        f"{many(summary['reports_sent'], 'report')} sent, {summary['reports_acknowledged']} acknowledged, "
        f"{summary['reports_lost']} lost; {many(summary['tiles_published'], 'tile version')} published, "
        f"{many(summary['updates_received'], 'update')} received, {many(summary['changed_voxels'], 'voxel')} changed",
        *traffic_lines(traffic),
    ]
    if waiting["voxels"]:
        lines.append(
            f"waiting for confirmation: {many(waiting['voxels'], 'voxel')} in {many(waiting['tiles'], 'tile')}: another"
            " vehicle that finds the same confirms it (`gnd map status`)"
        )
    if waiting["parked"]:
        lines.append(
            f"parked: {many(waiting['parked'], 'new voxel')} with the shape of a standing vehicle: published after"
            " standing for long (`confirmation.parked_h`)"
        )
    if waiting["season"]:
        lines.append(
            f"season: {many(waiting['season'], 'changed voxel')} of leaves of trees that stayed: no change of the map"
        )
    lines += [one["says"] for one in summary["named_vehicles"]]
    if p95["longitudinal_m"] is not None:
        lines.append(
            f"localisation, 95 % of errors: {p95['longitudinal_m'] * 100:.1f} cm along, "
            f"{p95['lateral_m'] * 100:.1f} cm across, {p95['heading_deg']:.3f} degrees"
        )
    if f1["before"] is not None:
        lines.append(
            f"map against the truth, macro F1 of observable voxels: {f1['before']:.1f} % before, "
            f"{_single_text(f1)}{f1['after']:.1f} % after"
            f" (all: {f1['levels']['all']['after']:.1f} %, scored: {f1['levels']['scored']['after']:.1f} %)"
        )
    lines += made_up_lines(summary.get("made_up"))
    lines += learning_lines(summary.get("learning", {}))
    lines += [
        f"{vehicle} doubts itself: {many(d['scans_shifted'] + d['scans_taken_back'], 'scan')} taken back, "
        f"{many(d['tiles_held_back'], 'tile')} with {many(d['changes_held_back'], 'change')} held back, "
        f"{d['tiles_doubtful']} doubtful "
        f"({_reasons(d['tiles'])}); largest shift "
        f"{d['largest_shift_m'] * 100:.0f} cm, {d['largest_turn_deg']:.2f} degrees"
        for vehicle, d in summary.get("doubtful", {}).items()
    ]
    lines += feature_lines(summary.get("features", {}))
    return lines


def _links_text(link: str) -> str:
    return "links without a limit" if link == "none" else f"{link} links"


def _reasons(tiles: dict[str, int]) -> str:
    return ", ".join(f"{n} {reason.replace('_', ' ')}" for reason, n in tiles.items()) or "none"


def _single_text(f1: dict[str, Any]) -> str:
    """What one vehicle alone finds, by those that had nothing from others."""
    if f1["single"] is None:
        return ""
    return f"{f1['single']:.1f} % by a single drive (of {len(f1['single_by_vehicle'])} on the old map), "
