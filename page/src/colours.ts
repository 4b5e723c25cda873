// What a Gaussian's colour tells, and the legend that says so.

import palette from "./palette.json";
import { METRES_PER_STEP, NEW, SURVEYED, type Packed } from "./packed";

export type Mode = "height" | "surface" | "change" | "age" | "evidence";
export const MODES: Mode[] = ["change", "height", "surface", "age", "evidence"];
export { palette };

export interface Shades {
  mode: Mode;
  /** Heights in the map's frame between which the ramp runs, m. */
  low: number;
  high: number;
  /** Since when a change counts, and the time that is shown, POSIX s. */
  from_s: number;
  now_s: number;
}

type RGB = [number, number, number];

export function rgb(hex: string): RGB {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16)) as RGB;
}

const RAMP: RGB[] = palette.ramp.map(rgb);
const CHANGE = { surveyed: rgb(palette.change.surveyed), new: rgb(palette.change.new), modified: rgb(palette.change.modified) };
const SURFACE = {
  ground: rgb(palette.surface.ground),
  upright: rgb(palette.surface.upright),
  line: rgb(palette.surface.line),
  other: rgb(palette.surface.other),
};
const AGES_S = [60, 3600, 86_400, 604_800, 2_592_000, 31_536_000];
const AGE_WORDS = ["minute", "hour", "day", "week", "month", "year"];

function ramp(part: number): RGB {
  const at = Math.max(0, Math.min(1, part)) * (RAMP.length - 1);
  const i = Math.min(Math.floor(at), RAMP.length - 2);
  const f = at - i;
  return [0, 1, 2].map((c) => RAMP[i][c] + f * (RAMP[i + 1][c] - RAMP[i][c])) as RGB;
}

/** Younger is lighter: a second 1, a year or more 0. */
function ageShare(age_s: number): number {
  return 1 - Math.log(Math.max(age_s, 1)) / Math.log(AGES_S[5]);
}

function evidenceShare(points: number, reports: number): number {
  return Math.min(1, Math.log2(1 + points) / 14 + Math.min(reports, 4) / 12);
}

function surfaceOf(p: Packed, i: number): RGB {
  const [a, b, c] = [p.shape[4 * i], p.shape[4 * i + 1], p.shape[4 * i + 2]];
  if (c > 0.4 * a) return SURFACE.other;
  if (b < 0.35 * a) return SURFACE.line;
  const [x, y] = [p.turn[4 * i] / 32767, p.turn[4 * i + 1] / 32767];
  const up = Math.abs(1 - 2 * (x * x + y * y)); // the z part of the third axis
  return up > 0.8 ? SURFACE.ground : up < 0.45 ? SURFACE.upright : SURFACE.other;
}

export function colourOf(p: Packed, i: number, up_m: number, shades: Shades): RGB {
  switch (shades.mode) {
    case "height":
      return ramp((p.mean[3 * i + 2] + up_m - shades.low) / Math.max(shades.high - shades.low, 1));
    case "surface":
      return surfaceOf(p, i);
    case "age":
      return ramp(ageShare(shades.now_s - p.since[i]));
    case "evidence":
      return ramp(evidenceShare(p.shape[4 * i + 3], p.reports[i]));
    case "change":
      if (p.kind[i] === SURVEYED || p.since[i] <= shades.from_s) return CHANGE.surveyed;
      return p.kind[i] === NEW ? CHANGE.new : CHANGE.modified;
  }
}

export interface Legend {
  title: string;
  /** Colour and word of each class, or ... */
  classes: [string, string][];
  /** ... the words at the two ends of the ramp. */
  ends: [string, string] | null;
}

export function legend(shades: Shades): Legend {
  const c = palette.change;
  const s = palette.surface;
  switch (shades.mode) {
    case "height":
      return { title: "Height", classes: [], ends: [`${shades.low.toFixed(0)} m`, `${shades.high.toFixed(0)} m`] };
    case "age":
      return { title: "Last changed", classes: [], ends: [`a ${AGE_WORDS[5]} ago`, "now"] };
    case "evidence":
      return { title: "Weight of evidence (points, reports)", classes: [], ends: ["little", "much"] };
    case "surface":
      return {
        title: "Surface",
        classes: [[s.ground, "level: ground"], [s.upright, "upright: walls"], [s.line, "thin: poles, edges"], [s.other, "other: leaves, slopes"]],
        ends: null,
      };
    case "change":
      return {
        title: "Change since the survey",
        classes: [[c.surveyed, "as surveyed"], [c.new, "new"], [c.modified, "modified"], [c.deleted, "deleted (ghost)"]],
        ends: null,
      };
  }
}

export function metres(step: number): number {
  return step * METRES_PER_STEP;
}
