// Small pictures of a change, before and after: drawn once when they are seen, by the renderer of the map.

import * as THREE from "three";
import { ask, type Change, type TileInfo } from "./api";
import { palette, rgb } from "./colours";
import { Drawable, type Looks, meshOf } from "./gaussians";
import { missing, type Packed, renewed, subset } from "./packed";

export const WIDE = 148;
export const HIGH = 96;
const SCALE = 2;
const KEPT = 300;
const VIEW_DEG = 34;
const FROM = new THREE.Vector3(-0.35, -0.62, 0.5).normalize();

type Load = (info: TileInfo, version: number) => Promise<Packed>;

interface Part {
  info: TileInfo;
  before: Packed | null;
  after: Packed | null;
}

export class Pictures {
  private readonly target = new THREE.WebGLRenderTarget(WIDE * SCALE, HIGH * SCALE, { samples: 4 });
  private readonly camera = new THREE.PerspectiveCamera(VIEW_DEG, WIDE / HIGH, 0.5, 2000);
  private readonly kept = new Map<string, [ImageData, ImageData]>();
  private readonly infos = new Map<number, Promise<TileInfo>>();
  private queue: Promise<unknown> = Promise.resolve();
  drawn = 0;

  constructor(
    private readonly renderer: THREE.WebGLRenderer,
    private readonly looks: Looks,
    private readonly load: Load,
  ) {
    this.camera.up.set(0, 0, 1);
  }

  /** Draws a change into two canvases, after those that were asked for before. */
  show(one: Change, before: HTMLCanvasElement, after: HTMLCanvasElement): Promise<unknown> {
    this.queue = this.queue.then(() => this.into(one, before, after)).catch((error) => {
      before.title = after.title = `no picture: ${(error as Error).message}`;
    });
    return this.queue;
  }

  private async into(one: Change, before: HTMLCanvasElement, after: HTMLCanvasElement): Promise<void> {
    const name = one.key + one.parts.map((part) => `/${part.tile}-${part.before}-${part.version}`).join("");
    let pair = this.kept.get(name);
    if (!pair) {
      if (!before.isConnected) return; // the list was made anew meanwhile
      const parts = await Promise.all(one.parts.map((part) => this.part(part)));
      pair = [this.picture(one, parts, true), this.picture(one, parts, false)];
      this.kept.set(name, pair);
      if (this.kept.size > KEPT) this.kept.delete(this.kept.keys().next().value!);
    }
    [before, after].forEach((canvas, i) => {
      canvas.getContext("2d")!.putImageData(pair![i], 0, 0);
      canvas.dataset.drawn = "yes";
    });
    this.drawn++;
  }

  private async part(part: Change["parts"][number]): Promise<Part> {
    if (!this.infos.has(part.tile)) this.infos.set(part.tile, ask<TileInfo>(`tiles/${part.tile}`));
    const info = await this.infos.get(part.tile)!;
    const [before, after] = await Promise.all([part.before ? this.load(info, part.before) : null, this.load(info, part.version)]);
    return { info, before, after };
  }

  private picture(one: Change, parts: Part[], isBefore: boolean): ImageData {
    const scene = new THREE.Scene();
    const made: Drawable[] = [];
    const middle = new THREE.Vector3(one.at_m[0], one.at_m[1], one.at_m[2] + one.tall_m / 2);
    const reach = Math.max(3, 0.62 * Math.max(one.length_m, one.tall_m) + 1.5);
    for (const part of parts) {
      const drawable = drawableOf(part, isBefore, middle, reach);
      if (!drawable) continue;
      const mesh = meshOf(drawable.ellipsoids, this.looks.ellipsoid);
      mesh.matrix.copy(matrixOf(part.info));
      scene.add(mesh);
      made.push(drawable);
    }
    const fits = Math.max(3, 0.36 * one.length_m + 0.42 * one.tall_m + 1.5); // looked at askance, a length is less high
    const far = fits / Math.tan((VIEW_DEG * Math.PI) / 360);
    this.camera.position.copy(middle).addScaledVector(FROM, far);
    this.camera.lookAt(middle);
    const picture = this.rendered(scene);
    for (const drawable of made) drawable.dispose();
    return picture;
  }

  private rendered(scene: THREE.Scene): ImageData {
    const [width, height] = [WIDE * SCALE, HIGH * SCALE];
    const from = new Uint8Array(4 * width * height);
    const alpha = this.renderer.getClearAlpha();
    this.renderer.setClearAlpha(0); // what lies behind is the canvas's own colour
    this.renderer.setRenderTarget(this.target);
    this.renderer.clear();
    this.renderer.render(scene, this.camera);
    this.renderer.readRenderTargetPixels(this.target, 0, 0, width, height, from);
    this.renderer.setRenderTarget(null);
    this.renderer.setClearAlpha(alpha);
    const picture = new ImageData(width, height);
    for (let y = 0; y < height; y++) picture.data.set(from.subarray(4 * width * (height - 1 - y), 4 * width * (height - y)), 4 * width * y);
    return picture;
  }
}

export function matrixOf(info: TileInfo): THREE.Matrix4 {
  const [x, y, z] = info.place;
  const t = info.turn;
  return new THREE.Matrix4().set(t[0], t[1], t[2], x, t[3], t[4], t[5], y, t[6], t[7], t[8], z, 0, 0, 0, 1);
}

/** What lies around the middle, grey, and what the change is in its colours. */
function drawableOf(part: Part, isBefore: boolean, middle: THREE.Vector3, reach: number): Drawable | null {
  const [shown, other] = isBefore ? [part.before, part.after] : [part.after, part.before];
  if (!shown) return null;
  const at = middle.clone().applyMatrix4(matrixOf(part.info).invert());
  const rows: number[] = [];
  for (let i = 0; i < shown.n; i++) {
    if (Math.hypot(shown.mean[3 * i] - at.x, shown.mean[3 * i + 1] - at.y) < 2.2 * reach) rows.push(i);
  }
  const only = new Set(other ? missing(shown, other) : rows);
  const changed = new Set(isBefore || !other ? [] : renewed(other, shown).filter((row) => !only.has(row)));
  const c = palette.change;
  const [still, apart, otherwise] = [c.surveyed, isBefore ? c.deleted : c.new, c.modified].map(rgb);
  const drawable = new Drawable(subset(shown, rows));
  drawable.paint((row) => (only.has(rows[row]) ? apart : changed.has(rows[row]) ? otherwise : still));
  return drawable;
}
