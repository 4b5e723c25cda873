// Versions of tiles as the server packs them (gnd.deploy.serve.packed_tile), as columns.

export const SURVEYED = 0;
export const NEW = 1;
export const METRES_PER_STEP = 1e-4;

export interface Packed {
  n: number;
  version: number;
  level: number;
  mean: Float32Array;
  voxel: Int32Array;
  since: Uint32Array;
  turn: Int16Array;
  shape: Uint16Array;
  reports: Uint16Array;
  cells: Uint16Array;
  kind: Uint8Array;
  low: number;
  high: number;
}

export function unpack(bytes: ArrayBuffer): Packed {
  const head = new DataView(bytes);
  if (bytes.byteLength < 16 || head.getUint32(0, false) !== 0x474e4431) throw new Error("a tile that is none");
  const n = head.getUint32(4, true);
  let at = 16;
  const take = <T>(make: (buffer: ArrayBuffer, at: number, length: number) => T, size: number, length: number): T => {
    const column = make(bytes, at, length);
    at += size * length;
    return column;
  };
  const packed = {
    n,
    version: head.getUint32(8, true),
    level: head.getUint32(12, true),
    mean: take((b, o, l) => new Float32Array(b, o, l), 4, 3 * n),
    voxel: take((b, o, l) => new Int32Array(b, o, l), 4, n),
    since: take((b, o, l) => new Uint32Array(b, o, l), 4, n),
    turn: take((b, o, l) => new Int16Array(b, o, l), 2, 4 * n),
    shape: take((b, o, l) => new Uint16Array(b, o, l), 2, 4 * n),
    reports: take((b, o, l) => new Uint16Array(b, o, l), 2, n),
    cells: take((b, o, l) => new Uint16Array(b, o, l), 2, n),
    kind: take((b, o, l) => new Uint8Array(b, o, l), 1, n),
    low: Infinity,
    high: -Infinity,
  };
  if (at !== bytes.byteLength) throw new Error(`a tile of ${bytes.byteLength} bytes, not ${at}`);
  for (let i = 0; i < n; i++) {
    const up = packed.mean[3 * i + 2];
    if (up < packed.low) packed.low = up;
    if (up > packed.high) packed.high = up;
  }
  return packed;
}

/** Rows of `a` whose voxel `b` does not have; both are sorted by voxel. */
export function missing(a: Packed, b: Packed): number[] {
  const rows: number[] = [];
  let j = 0;
  for (let i = 0; i < a.n; i++) {
    while (j < b.n && b.voxel[j] < a.voxel[i]) j++;
    if (j >= b.n || b.voxel[j] !== a.voxel[i]) rows.push(i);
  }
  return rows;
}

/** Rows of `b` that `a` does not have, or has otherwise. */
export function renewed(a: Packed, b: Packed): number[] {
  const rows: number[] = [];
  let i = 0;
  for (let j = 0; j < b.n; j++) {
    while (i < a.n && a.voxel[i] < b.voxel[j]) i++;
    if (i >= a.n || a.voxel[i] !== b.voxel[j] || a.since[i] !== b.since[j]) rows.push(j);
  }
  return rows;
}

export function subset(a: Packed, rows: number[]): Packed {
  const pick = <T extends { [i: number]: number }>(from: T, into: T, width: number): T => {
    rows.forEach((row, k) => {
      for (let c = 0; c < width; c++) into[k * width + c] = from[row * width + c];
    });
    return into;
  };
  const n = rows.length;
  return {
    n,
    version: a.version,
    level: a.level,
    low: a.low,
    high: a.high,
    mean: pick(a.mean, new Float32Array(3 * n), 3),
    voxel: pick(a.voxel, new Int32Array(n), 1),
    since: pick(a.since, new Uint32Array(n), 1),
    turn: pick(a.turn, new Int16Array(4 * n), 4),
    shape: pick(a.shape, new Uint16Array(4 * n), 4),
    reports: pick(a.reports, new Uint16Array(n), 1),
    cells: pick(a.cells, new Uint16Array(n), 1),
    kind: pick(a.kind, new Uint8Array(n), 1),
  };
}
