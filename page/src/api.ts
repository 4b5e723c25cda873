// What the server answers, and how it is asked.

export interface About {
  title: string;
  key: string;
  layer: string;
  origin_deg: [number, number];
  extent_m: [number, number, number, number];
  ground_m: number;
  tiles: number;
  changed_tiles: number;
  first_ms: number;
  last_ms: number;
  changed_ms: number;
  feature_layers: string[];
  live: boolean;
  replay: number;
  viewer: string;
  may_decide: boolean;
}

export interface TileInfo {
  id: number;
  path: string;
  version: number;
  place: [number, number, number];
  turn: number[];
  versions: [number, number][];
}

export interface Vehicle {
  name: string;
  at: [number, number, number, number] | null;
  heading_rad: number | null;
  odometer_m: number;
  health: string;
  /** Its drive has. */
  ended: boolean;
  tiles: number;
  reports: number;
  doubts: number;
}

export interface Report {
  id: string;
  vehicle: string | null;
  /** By the clock of the drive, which a simulated or recorded one brings along. */
  driven_ms: number;
  says: string | null;
  rays: Record<string, number> | null;
}

export interface Story {
  tile: number;
  path: string;
  voxel: number;
  version: number;
  lat_deg: number;
  lon_deg: number;
  height_m: number;
  gaussian: { points: number; cells: number; mean_m: number[]; sd_m: number[] } | null;
  steps: { version: number; kind: string; what: string; created_ms: number; merger: string; reports: Report[] }[];
}

export interface Change {
  change: "new" | "deleted" | "modified";
  shape: string;
  at_m: [number, number, number];
  length_m: number;
  width_m: number;
  tall_m: number;
  voxels: number;
  vehicles: number | null;
  reports: number;
  confidence: number | null;
  first_seen: string | null;
  last_seen: string | null;
  /** Names the change as long as it is of the same voxels; "": it cannot be decided about. */
  key: string;
  parts: { tile: number; before: number; version: number }[];
  accepted: Decision | null;
}

export interface Decision {
  key: string;
  at_ms: number;
  who: string;
  judgement: string;
  why: string;
  tiles: number;
}

export interface WorkList {
  changes: Change[];
  alone: number;
  left_out: number;
  decided: Decision[];
}

export interface Feature {
  id: string;
  kind: string;
  points_m: [number, number, number][];
  attributes: Record<string, string>;
  existence: { exist: number };
  hits: number;
  vehicles: number;
}

export type Message =
  | { type: "update"; layer: string; before: number; version: number; tile?: TileInfo }
  | { type: "vehicles"; vehicles: Vehicle[] }
  | { type: "status"; status: any }
  | { type: "ended" }
  | { type: "decided" }
  | { type: "reload" };

async function asked(path: string, more: RequestInit = {}): Promise<Response> {
  const answer = await fetch(path, { credentials: "same-origin", ...more });
  if (!answer.ok) {
    const told = await answer.json().catch(() => ({}));
    throw new Error(told.error ?? `the server answers ${answer.status}`);
  }
  return answer;
}

export async function ask<T>(path: string): Promise<T> {
  return (await asked(`api/${path}`)).json();
}

export async function askBytes(path: string): Promise<ArrayBuffer> {
  return (await asked(`api/${path}`)).arrayBuffer();
}

export async function post(path: string, what: unknown): Promise<void> {
  await asked(`api/${path}`, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(what) });
}

/** Follows the server for ever; a lost connection is made anew, ever more patiently. */
export function follow(onMessage: (message: Message) => void, onState: (isOpen: boolean, isFirst: boolean) => void): void {
  let pause_ms = 250;
  let isFirst = true;
  const open = () => {
    const address = new URL("api/live", location.href);
    address.protocol = address.protocol.replace("http", "ws");
    address.hash = "";
    const socket = new WebSocket(address);
    socket.onopen = () => {
      pause_ms = 250;
      onState(true, isFirst);
      isFirst = false;
    };
    socket.onmessage = (event) => onMessage(JSON.parse(event.data));
    socket.onclose = () => {
      onState(false, isFirst);
      setTimeout(open, pause_ms);
      pause_ms = Math.min(pause_ms * 2, 5000);
    };
  };
  open();
}
