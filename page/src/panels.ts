// What stands beside the map, as elements. Every word from the server is set as text.

import type { Story, Vehicle } from "./api";
import { palette } from "./colours";
import { bytes, facts, make, many, span, swatch, when } from "./dom";

const WHAT: Record<string, string> = { surveyed: "surveyed", new: "new", modified: "modified", deleted: "deleted", empty: "nothing here" };

export function voxelPanel(story: Story): Node[] {
  const g = story.gaussian;
  const head = facts([
    ["Tile", make("span", {}, story.path)],
    ["Voxel", String(story.voxel)],
    ["Tile version", String(story.version)],
    ["Place", `${story.lat_deg.toFixed(6)}°, ${story.lon_deg.toFixed(6)}°`],
    ["Height", `${story.height_m.toFixed(1)} m`],
    ...(g
      ? ([
          ["Points", g.points.toLocaleString("en")],
          ["10 cm cells", String(g.cells)],
          ["Half axes (1 σ)", g.sd_m.map((one) => `${(one * 100).toFixed(1)}`).join(" × ") + " cm"],
        ] as [string, string][])
      : ([["Now", "no Gaussian"]] as [string, string][])),
  ]);
  const steps = [...story.steps].reverse().map((step) => {
    const reports = step.reports.map((one) =>
      make(
        "li",
        {},
        make("strong", {}, one.vehicle ?? "unknown vehicle"),
        one.says ? ` says ${one.says}` : "",
        make("div", { class: "soft num" }, `driven ${when(one.driven_ms)}, by the drive's clock`),
        one.rays && raysOf(one.rays) && make("div", { class: "soft num" }, `rays: ${raysOf(one.rays)}`),
      ),
    );
    return make(
      "section",
      { class: "step" },
      make("h3", {}, make("span", {}, `Version ${step.version}: ${WHAT[step.what] ?? step.what}`)),
      make("div", { class: "soft num" }, `published ${when(step.created_ms)}${step.merger ? `, by ${step.merger}` : ""}`),
      reports.length ? make("ul", {}, ...reports) : make("div", { class: "soft" }, step.kind === "base" ? "from a survey" : "no report names this voxel"),
    );
  });
  return [head, ...steps];
}

/** The rays that there were; "" where a voxel is new, and none is counted. */
function raysOf(rays: Record<string, number>): string {
  return Object.entries(rays)
    .filter(([, n]) => n > 0)
    .map(([name, n]) => `${n} ${name.replaceAll("_", " ")}`)
    .join(", ");
}

export function fleetItems(vehicles: Vehicle[], go: (one: Vehicle) => void): HTMLElement {
  if (!vehicles.length) return make("p", { class: "empty" }, "No vehicle has been seen. Those of a run appear when they have driven a few metres.");
  const list = make("ul", { class: "items" });
  for (const one of vehicles) {
    const button = make(
      "button",
      { type: "button", class: "item" },
      make("span", { class: "head" }, swatch((palette.health as Record<string, string>)[one.health] ?? palette.change.surveyed), make("span", {}, one.name)),
      make(
        "span",
        { class: "soft num" },
        `${healthOf(one)}; ${(one.odometer_m / 1000).toFixed(2)} km driven` +
          (one.tiles ? `; ${many(one.tiles, "tile")}, ${many(one.reports, "report")}` : "") +
          (one.doubts ? `; ${many(one.doubts, "tile")} in doubt` : ""),
      ),
    );
    button.addEventListener("click", () => go(one));
    list.append(make("li", {}, button));
  }
  return list;
}

function healthOf(one: Vehicle): string {
  if (!one.health) return one.ended ? "ended" : "health not told yet";
  return one.ended ? `ended; its last health: ${one.health}` : `health ${one.health}`;
}

export function trafficPanel(told: any): Node[] {
  if (told.problem) return [make("p", { class: "empty" }, told.problem)];
  const fleet = told.fleet;
  const rows = told.links.map((one: any) =>
    make("tr", {}, make("td", {}, String(one.link).toUpperCase()), make("td", {}, percent(one.down_share)), make("td", {}, percent(one.up_share)), make("td", {}, seconds(one.down_wait_s)), make("td", {}, seconds(one.up_wait_s))),
  );
  const kinds = fleet.lines
    .filter((one: any) => one.wire_bytes > 0)
    .sort((a: any, b: any) => b.wire_bytes - a.wire_bytes)
    .map((one: any) => make("tr", {}, make("td", {}, `${one.kind} ${one.direction}`), make("td", {}, one.messages ? one.messages.toLocaleString("en") : ""), make("td", {}, bytes(one.wire_bytes))));
  return [
    facts([
      ["On the wire", bytes(fleet.up_wire_bytes + fleet.down_wire_bytes)],
      ["Driven", `${fleet.drive_km.toFixed(2)} km`],
      ["A kilometre", `${fleet.all_kB_per_km.toFixed(1)} kB`],
      ["of it tiles", `${fleet.tiles_kB_per_km.toFixed(1)} kB`],
    ]),
    make("h2", {}, "Against mobile links"),
    make("p", { class: "soft" }, "The vehicle that needs most: its share of the link, and its longest wait."),
    table(["link", "down", "up", "wait down", "wait up"], rows),
    make("h2", {}, "By kind"),
    table(["kind", "messages", "wire"], kinds),
  ];
}

function table(head: string[], rows: Node[]): HTMLElement {
  return make("table", { class: "table" }, make("thead", {}, make("tr", {}, ...head.map((one) => make("th", { scope: "col" }, one)))), make("tbody", {}, ...rows));
}

function percent(share: number): string {
  return share < 0.0095 ? `${(100 * share).toFixed(2)} %` : `${(100 * share).toFixed(1)} %`;
}

function seconds(s: number): string {
  return s < 0.0005 ? "–" : `${s.toFixed(2)} s`;
}

export function cloudPanel(told: any): Node[] {
  const waiting = told.waiting_for_confirmation;
  const lag = told.merge_lag_s;
  const shards = told.shards.map((one: any) => make("tr", {}, make("td", {}, String(one.owner)), make("td", {}, one.is_alive ? "alive" : "silent")));
  const parts: Node[] = [
    facts([
      ["Queue", many(told.queue.tiles, "tile")],
      ["Oldest waits", told.queue.tiles ? `${told.queue.waiting_s.toFixed(1)} s` : "–"],
      ["Receipt to version", lag.p50 === null ? "–" : `${lag.p50.toFixed(2)} s (95 %: ${lag.p95.toFixed(2)} s)`],
      ["In quarantine", many(told.quarantined, "message")],
      ["Set aside", many(told.set_aside.length, "tile")],
      ["Wait for a second witness", `${many(waiting.voxels, "voxel")} in ${many(waiting.tiles, "tile")}`],
      ["Parked", many(waiting.parked, "voxel")],
      ["Leaves", many(waiting.season, "voxel")],
    ]),
    make("h2", {}, "Merger shards"),
    shards.length ? table(["shard", "state"], shards) : make("p", { class: "empty" }, "None is running."),
  ];
  if (told.named_vehicles.length) {
    parts.push(make("h2", {}, "Vehicles to be checked"), make("ul", { class: "items" }, ...told.named_vehicles.map((one: any) => make("li", { class: "item" }, String(one.says)))));
  }
  if (waiting.claims.length) {
    parts.push(make("h2", {}, "Waiting for confirmation"));
    const claims = waiting.claims.map((one: any) =>
      make("li", { class: "item" }, make("div", { class: "head" }, String(one.vehicle)), make("div", { class: "soft" }, `${many(one.voxels, "voxel")} of ${one.seen} seen; ${one.why}; for ${span(Date.now() - one.since_ns / 1e6)}`)),
    );
    parts.push(make("ul", { class: "items" }, ...claims));
  }
  return parts;
}
