// The tiles in view: which versions are shown, loaded by distance, as ellipsoids, discs or merged blocks.

import * as THREE from "three";
import { ask, askBytes, type About, type TileInfo } from "./api";
import { palette, rgb, type Shades } from "./colours";
import { Drawable, type Looks, meets, meshOf, paint, pointsMesh } from "./gaussians";
import { missing, type Packed, renewed, subset, unpack } from "./packed";
import { matrixOf } from "./pictures";

const REACH_M = 1500;
const AT_ONCE = 8;
const MOST_GAUSSIANS = 2_500_000;
const GHOST_S = 3.0;

interface Loaded {
  packed: Packed;
  drawable: Drawable;
  painted: string;
}

export interface Side {
  /** POSIX ms; Infinity: the newest. */
  time_ms: number;
  group: THREE.Group;
}

/** What shows one side of a tile: triangles where it is near, points where it is far. */
interface Slot {
  mesh: THREE.Mesh;
  points: THREE.Points;
  loaded: Loaded | null;
}

function hide(slot: Slot): void {
  slot.mesh.visible = slot.points.visible = false;
}

class Tile {
  readonly loaded = new Map<string, Loaded>();
  readonly slots: [Slot, Slot];
  readonly centre: THREE.Vector3;
  readonly matrix: THREE.Matrix4;
  ghost: { mesh: THREE.Mesh; of: string; until_s: number } | null = null;
  far = 0;
  isListed = true;

  constructor(public info: TileInfo, looks: Looks, ground_m: number, groups: [THREE.Group, THREE.Group]) {
    const [x, y, z] = info.place;
    this.matrix = matrixOf(info);
    this.centre = new THREE.Vector3(x, y, z + ground_m);
    this.slots = groups.map((group) => {
      const slot: Slot = { mesh: meshOf(new THREE.BufferGeometry(), looks.disc), points: pointsMesh(looks.point), loaded: null };
      for (const one of [slot.mesh, slot.points]) {
        one.matrix.copy(this.matrix);
        group.add(one);
      }
      hide(slot);
      return slot;
    }) as unknown as [Slot, Slot];
  }

  versionAt(time_ms: number): number {
    const { versions } = this.info;
    for (let i = versions.length - 1; i >= 0; i--) if (versions[i][1] <= time_ms) return versions[i][0];
    return 0;
  }
}

export interface Hit {
  tile: TileInfo;
  version: number;
  packed: Packed;
  row: number;
  at: THREE.Vector3;
}

export class Tiles {
  readonly tiles = new Map<number, Tile>();
  readonly before: Side = { time_ms: 0, group: new THREE.Group() };
  readonly after: Side = { time_ms: Infinity, group: new THREE.Group() };
  readonly ghosts = new THREE.Group();
  comparing = false;
  showGhosts = true;
  /** Below 1 less is drawn finely. */
  quality = 1;
  /** What is nearer is drawn as ellipsoids, ... */
  near_m = 55;
  /** ... as discs, a triangle each; what is farther as points. */
  disc_m = 130;
  /** What is nearer is drawn voxel by voxel, ... */
  fine_m = 220;
  /** ... in blocks of 2 x 2 x 2 voxels; what is farther of 4 x 4 x 4. */
  block_m = 420;
  drawn = { tiles: 0, gaussians: 0 };
  leftOut = 0;
  private wanted: { tile: Tile; version: number; level: number; far: number }[] = [];
  private underway = new Set<string>();
  private failed = new Map<string, number>();
  private listedAt: { x: number; y: number; reach: number } | null = null;
  private listing = false;

  constructor(
    private readonly about: About,
    private readonly looks: Looks,
    private shades: Shades,
    private readonly changed: () => void,
    private readonly trouble: (text: string) => void,
  ) {}

  get isLoading(): boolean {
    return this.underway.size > 0 || this.listing || this.wanted.length > 0;
  }

  get isEmpty(): boolean {
    return this.tiles.size === 0;
  }

  /** Lists the tiles around a place again when the view has moved on. */
  async lookAround(target: THREE.Vector3, reach_m: number, anew = false): Promise<void> {
    const reach = Math.min(Math.max(reach_m, 150), REACH_M);
    const was = this.listedAt;
    const isNear = was && Math.hypot(target.x - was.x, target.y - was.y) < 0.25 * was.reach && Math.abs(Math.log(reach / was.reach)) < 0.35;
    if (this.listing || (isNear && !anew)) return;
    this.listing = true;
    this.listedAt = { x: target.x, y: target.y, reach };
    try {
      const box = [target.x - reach, target.y - reach, target.x + reach, target.y + reach].map((one) => one.toFixed(1));
      const told = await ask<{ tiles: TileInfo[]; left_out: number }>(`tiles?box=${box.join(",")}`);
      this.leftOut = told.left_out;
      const listed = new Set(told.tiles.map((one) => one.id));
      for (const [id, tile] of this.tiles) tile.isListed = listed.has(id);
      for (const info of told.tiles) this.take(info);
      this.forget();
    } catch (error) {
      this.listedAt = null;
      this.trouble(`The tiles here could not be listed: ${(error as Error).message}`);
    } finally {
      this.listing = false;
      this.changed();
    }
  }

  take(info: TileInfo): Tile {
    let tile = this.tiles.get(info.id);
    if (tile) tile.info = info;
    else {
      tile = new Tile(info, this.looks, this.about.ground_m, [this.before.group, this.after.group]);
      this.tiles.set(info.id, tile);
    }
    return tile;
  }

  /** A version was published: load it at once, and let what it changed flash. */
  async update(info: TileInfo, before: number): Promise<void> {
    const tile = this.tiles.get(info.id);
    if (!tile && this.listedAt) {
      const far = Math.hypot(info.place[0] - this.listedAt.x, info.place[1] - this.listedAt.y);
      if (far > this.listedAt.reach) return;
    }
    const known = this.take(info);
    if (this.after.time_ms !== Infinity) return this.changed();
    try {
      const [old, now] = await Promise.all([before ? this.load(known, before, 0) : null, this.load(known, info.version, 0)]);
      const now_s = performance.now() / 1000;
      now.drawable.flash(old ? renewed(old.packed, now.packed) : [...Array(now.packed.n).keys()], now_s);
      if (old) this.leave(known, old.packed, now.packed, now_s + GHOST_S);
    } catch (error) {
      this.trouble(`Version ${info.version} of a tile could not be read: ${(error as Error).message}`);
    }
    this.changed();
  }

  setShades(shades: Shades): void {
    this.shades = shades;
    this.changed();
  }

  /** Chooses what is drawn for a camera; true: something is still on its way. */
  arrange(camera: THREE.Vector3): boolean {
    this.wanted = [];
    this.drawn = { tiles: 0, gaussians: 0 };
    const now_s = performance.now() / 1000;
    for (const tile of this.tiles.values()) {
      tile.far = Math.max(0, tile.centre.distanceTo(camera) - 20);
      this.arrangeSide(tile, 1, this.after);
      if (this.comparing) this.arrangeSide(tile, 0, this.before);
      else hide(tile.slots[0]);
      this.arrangeGhost(tile, now_s);
    }
    this.wanted.sort((a, b) => a.far - b.far);
    this.fetchSome();
    return this.isLoading;
  }

  private arrangeSide(tile: Tile, index: 0 | 1, side: Side): void {
    const slot = tile.slots[index];
    const version = tile.versionAt(side.time_ms);
    const level = tile.far < this.fine_m * this.quality ? 0 : tile.far < this.block_m * this.quality ? 1 : 2;
    if (!version || !tile.isListed) {
      hide(slot);
      slot.loaded = null;
      return;
    }
    const best = tile.loaded.get(`${version}/${level}`);
    if (!best) this.want(tile, version, level);
    const found = best ?? [0, 1, 2].map((other) => tile.loaded.get(`${version}/${other}`)).find(Boolean) ?? slot.loaded;
    slot.loaded = found;
    if (!found) return hide(slot);
    this.show(tile, slot, found);
    if (index === 1) {
      this.drawn.tiles++;
      this.drawn.gaussians += found.packed.n;
    }
  }

  private show(tile: Tile, slot: Slot, found: Loaded): void {
    const isFar = tile.far >= this.disc_m * this.quality;
    const isNear = tile.far < this.near_m * this.quality && found.packed.level === 0;
    slot.points.visible = isFar;
    slot.mesh.visible = !isFar;
    if (isFar) slot.points.geometry = found.drawable.points;
    else {
      slot.mesh.geometry = isNear ? found.drawable.ellipsoids : found.drawable.discs;
      slot.mesh.material = isNear ? this.looks.ellipsoid : this.looks.disc;
    }
    const { mode, low, high, from_s, now_s } = this.shades;
    const how = `${mode}/${low}/${high}/${from_s}/${mode === "age" ? Math.floor(now_s / 30) : 0}`;
    if (found.painted !== how) {
      paint(found.drawable, found.packed, tile.info.place[2], this.shades);
      found.painted = how;
    }
  }

  /** What was deleted since the time before stays to be seen, as long as changes are shown. */
  private arrangeGhost(tile: Tile, now_s: number): void {
    if (tile.ghost && tile.ghost.until_s !== Infinity) {
      if (now_s < tile.ghost.until_s) return;
      this.dropGhost(tile);
    }
    const [a, b] = [tile.versionAt(this.before.time_ms), tile.versionAt(this.after.time_ms)];
    const isWanted = this.showGhosts && this.shades.mode === "change" && a && b && a !== b && tile.isListed && tile.far < this.fine_m * this.quality;
    const of = `${a}-${b}`;
    if (!isWanted || (tile.ghost && tile.ghost.of !== of)) this.dropGhost(tile);
    if (!isWanted || tile.ghost) return;
    const old = tile.loaded.get(`${a}/0`);
    const now = tile.loaded.get(`${b}/0`);
    if (!old) this.want(tile, a, 0);
    if (old && now) this.makeGhost(tile, old.packed, now.packed, of, Infinity);
  }

  private leave(tile: Tile, old: Packed, now: Packed, until_s: number): void {
    if (this.showGhosts && this.shades.mode === "change") return; // they stay anyway
    this.dropGhost(tile);
    this.makeGhost(tile, old, now, "", until_s);
  }

  private makeGhost(tile: Tile, old: Packed, now: Packed, of: string, until_s: number): void {
    const drawable = new Drawable(subset(old, missing(old, now)));
    const colour = rgb(palette.change.deleted);
    drawable.paint(() => colour);
    const mesh = meshOf(drawable.discs, this.looks.ghost);
    mesh.matrix.copy(tile.matrix);
    this.ghosts.add(mesh);
    tile.ghost = { mesh, of, until_s };
  }

  private dropGhost(tile: Tile): void {
    if (!tile.ghost) return;
    this.ghosts.remove(tile.ghost.mesh);
    (tile.ghost.mesh.geometry.userData.drawable as Drawable).dispose();
    tile.ghost = null;
  }

  private want(tile: Tile, version: number, level: number): void {
    const name = `${tile.info.id}/${version}/${level}`;
    const failed_s = this.failed.get(name);
    if (this.underway.has(name) || (failed_s !== undefined && performance.now() / 1000 - failed_s < 5)) return;
    this.wanted.push({ tile, version, level, far: tile.far });
  }

  private fetchSome(): void {
    while (this.wanted.length && this.underway.size < AT_ONCE) {
      const { tile, version, level } = this.wanted.shift()!;
      this.load(tile, version, level)
        .catch((error) => this.trouble(`A tile could not be read: ${error.message}`))
        .finally(() => {
          this.fetchSome();
          this.changed();
        });
    }
  }

  private async load(tile: Tile, version: number, level: number): Promise<Loaded> {
    const place = `${version}/${level}`;
    const known = tile.loaded.get(place);
    if (known) return known;
    const name = `${tile.info.id}/${place}`;
    this.underway.add(name);
    try {
      const packed = unpack(await askBytes(this.address(tile.info, version, level)));
      const loaded = tile.loaded.get(place) ?? { packed, drawable: new Drawable(packed), painted: "" };
      tile.loaded.set(place, loaded);
      this.failed.delete(name);
      return loaded;
    } catch (error) {
      this.failed.set(name, performance.now() / 1000);
      throw error;
    } finally {
      this.underway.delete(name);
    }
  }

  /** A version with every voxel; it is not kept here. */
  async packedOf(info: TileInfo, version: number): Promise<Packed> {
    const known = this.tiles.get(info.id)?.loaded.get(`${version}/0`);
    return known?.packed ?? unpack(await askBytes(this.address(info, version, 0)));
  }

  private address(info: TileInfo, version: number, level: number): string {
    return `tiles/${info.id}/${version}.bin?level=${level}&map=${this.about.key}`;
  }

  /** Memory is for what is near. */
  private forget(): void {
    let held = 0;
    const by_distance = [...this.tiles.values()].sort((a, b) => Number(b.isListed) - Number(a.isListed) || a.far - b.far);
    for (const tile of by_distance) {
      for (const [place, one] of tile.loaded) {
        held += one.packed.n;
        const isShown = tile.slots.some((slot) => slot.loaded === one);
        if (held > MOST_GAUSSIANS && !isShown) {
          one.drawable.dispose();
          tile.loaded.delete(place);
        }
      }
    }
  }

  /** The Gaussian that a ray of the map's frame meets first, on one side. */
  pick(ray: THREE.Ray, isBefore: boolean): Hit | null {
    let best: (Hit & { far: number }) | null = null;
    for (const tile of this.tiles.values()) {
      const slot = tile.slots[isBefore ? 0 : 1];
      const shown = slot.loaded && tile.loaded.get(`${slot.loaded.packed.version}/0`);
      if (!shown || !(slot.mesh.visible || slot.points.visible)) continue;
      const back = tile.matrix.clone().invert();
      const from = ray.origin.clone().applyMatrix4(back);
      const along = ray.direction.clone().transformDirection(back);
      const found = meets(shown.packed, from, along);
      if (found && (best === null || found.far < best.far)) {
        const p = shown.packed;
        const at = new THREE.Vector3().fromArray(p.mean, 3 * found.row).applyMatrix4(tile.matrix);
        best = { tile: tile.info, version: p.version, packed: p, row: found.row, at, far: found.far };
      }
    }
    return best;
  }

  /** Times of the versions of the tiles that are known, POSIX ms, ascending. */
  times(): number[] {
    const found: number[] = [];
    for (const tile of this.tiles.values()) for (const [, at] of tile.info.versions) found.push(at);
    return found.sort((a, b) => a - b);
  }

  /** Heights between which nearly all that is loaded lies. */
  heights(): [number, number] {
    const some: number[] = [];
    for (const tile of this.tiles.values()) {
      const p = tile.slots[1].loaded?.packed;
      if (!p) continue;
      const step = Math.max(1, Math.floor(p.n / 60));
      for (let i = 0; i < p.n; i += step) some.push(p.mean[3 * i + 2] + tile.info.place[2]);
    }
    some.sort((a, b) => a - b);
    if (some.length < 20) return [this.about.ground_m - 2, this.about.ground_m + 12];
    return [some[Math.floor(0.01 * some.length)], some[Math.floor(0.985 * some.length)]];
  }
}
