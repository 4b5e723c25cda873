// What lies over the Gaussians: the ground plan of all tiles, vehicles, features, and what is selected.

import * as THREE from "three";
import { ask, askBytes, type About, type Feature, type Vehicle } from "./api";
import { palette } from "./colours";
import { make } from "./dom";

const MOST_SQUARES = 6000;

/** Every tile of the map as a square on the ground, of a large map blocks of tiles: what is seen before they are near. */
export class Overview {
  readonly group = new THREE.Group();
  private mesh: THREE.Mesh | null = null;
  private hasChanged: boolean[] = [];
  private background = new THREE.Color();

  async read(about: About): Promise<void> {
    const bytes = await askBytes("overview.bin");
    const n = bytes.byteLength / 16;
    const [x, y] = [new Float32Array(bytes, 0, n), new Float32Array(bytes, 4 * n, n)];
    const version = new Uint32Array(bytes, 8 * n, n);
    const side = Math.ceil(Math.sqrt(n / MOST_SQUARES));
    const [dy, dx] = [side * 38.2, side * 38.2 * Math.cos((about.origin_deg[0] * Math.PI) / 180)];
    const blocks = new Map<string, [number, number, boolean]>();
    for (let i = 0; i < n; i++) {
      const [column, row] = side > 1 ? [Math.floor(x[i] / dx), Math.floor(y[i] / dy)] : [i, 0];
      const known = blocks.get(`${column}/${row}`);
      const middle = side > 1 ? [(column + 0.5) * dx, (row + 0.5) * dy] : [x[i], y[i]];
      blocks.set(`${column}/${row}`, [middle[0], middle[1], version[i] > 1 || (known?.[2] ?? false)]);
    }
    this.hasChanged = [...blocks.values()].map((one) => one[2]);
    this.mesh = squares([...blocks.values()], 0.47 * dx, 0.47 * dy, about.ground_m - 1.5);
    this.group.add(this.mesh);
    this.tint(this.background);
  }

  /** Little colour on that of the background: mixed as the eye sees it, for half a lamp's light is no half of the brightness. */
  tint(background: THREE.Color): void {
    this.background = background;
    const seen = background.clone().convertLinearToSRGB();
    const [still, changed] = [palette.change.surveyed, palette.change.new].map((one) =>
      seen.clone().lerp(new THREE.Color(one).convertLinearToSRGB(), 0.14).convertSRGBToLinear(),
    );
    const colours = this.mesh?.geometry.getAttribute("color");
    if (!colours) return;
    this.hasChanged.forEach((isOne, i) => {
      const { r, g, b } = isOne ? changed : still;
      for (let c = 0; c < 4; c++) colours.setXYZ(4 * i + c, r, g, b);
    });
    colours.needsUpdate = true;
  }
}

function squares(middles: [number, number, boolean][], half_x: number, half_y: number, up: number): THREE.Mesh {
  const at: number[] = [];
  const index: number[] = [];
  middles.forEach(([x, y], i) => {
    at.push(x - half_x, y - half_y, up, x + half_x, y - half_y, up, x + half_x, y + half_y, up, x - half_x, y + half_y, up);
    index.push(4 * i, 4 * i + 1, 4 * i + 2, 4 * i, 4 * i + 2, 4 * i + 3);
  });
  const geometry = new THREE.BufferGeometry().setIndex(index);
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(new Float32Array(at.length), 3));
  // Drawn first, under everything: a street may lie lower than its ground plan.
  const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ vertexColors: true, depthWrite: false, depthTest: false }));
  mesh.frustumCulled = false;
  mesh.renderOrder = -1;
  return mesh;
}

const HEALTH: Record<string, string> = palette.health;

function arrow(): THREE.BufferGeometry {
  const shape = new THREE.Shape();
  shape.moveTo(2.6, 0).lineTo(-1.6, 1.35).lineTo(-0.9, 0).lineTo(-1.6, -1.35).closePath();
  const geometry = new THREE.ExtrudeGeometry(shape, { depth: 0.7, bevelEnabled: false });
  return geometry;
}

const LABEL_PX = 24;

interface Label {
  element: HTMLElement;
  /** Of the middle of its lower edge, pixels. */
  x: number;
  y: number;
  far: number;
}

/** Labels that would cover each other stand above each other, that of the nearest lowest. */
function putLabels(labels: Label[]): void {
  for (const one of labels) one.element.hidden = false;
  const put: { x: number; y: number; half: number }[] = [];
  for (const one of labels.sort((a, b) => a.far - b.far)) {
    const half = one.element.offsetWidth / 2 + 2;
    const covered = () => put.find((other) => Math.abs(other.x - one.x) < half + other.half && Math.abs(other.y - one.y) < LABEL_PX - 0.5); // y - 24 is not quite 24 less where it is rounded
    for (let other = covered(); other; other = covered()) one.y = other.y - LABEL_PX;
    put.push({ x: one.x, y: one.y, half });
    one.element.style.transform = `translate(-50%, -100%) translate(${one.x.toFixed(1)}px, ${one.y.toFixed(1)}px)`;
  }
}

/** Vehicles as arrows with a label each. */
export class Vehicles {
  readonly group = new THREE.Group();
  readonly known = new Map<string, Vehicle>();
  private readonly marks = new Map<string, { mesh: THREE.Mesh; label: HTMLElement; name: HTMLElement; health: HTMLElement }>();
  private readonly shape = arrow();
  ways: Record<string, [number, number, number, number][]> = {};
  isShown = true;

  constructor(private readonly labels: HTMLElement) {}

  take(told: Vehicle[]): void {
    for (const one of told) {
      this.known.set(one.name, one);
      if (one.at) {
        const way = (this.ways[one.name] ??= []);
        if (!way.length || way[way.length - 1][0] < one.at[0]) way.push(one.at);
      }
    }
  }

  /** Places the arrows as at a time (Infinity: now) and their labels as the camera sees them. */
  draw(time_ms: number, camera: THREE.Camera, width: number, height: number): void {
    const seen: Label[] = [];
    for (const [name, vehicle] of this.known) {
      const at = time_ms === Infinity ? vehicle.at : placeAt(this.ways[name] ?? [], time_ms);
      const mark = this.mark(name, vehicle);
      const isThere = this.isShown && at !== null;
      mark.mesh.visible = isThere;
      mark.label.hidden = true;
      if (!at || !isThere) continue;
      mark.mesh.position.set(at[1], at[2], at[3] + 1.2);
      const heading = time_ms === Infinity ? vehicle.heading_rad : headingAt(this.ways[name] ?? [], time_ms);
      mark.mesh.rotation.z = heading ?? 0;
      const far = camera.position.distanceTo(mark.mesh.position);
      mark.mesh.scale.setScalar(Math.max(1, far / 90));
      const p = mark.mesh.position.clone().add(new THREE.Vector3(0, 0, 2 + far / 60)).project(camera);
      const isSeen = p.z < 1 && Math.abs(p.x) < 1.1 && Math.abs(p.y) < 1.1;
      if (isSeen) seen.push({ element: mark.label, x: ((p.x + 1) / 2) * width, y: ((1 - p.y) / 2) * height, far });
    }
    putLabels(seen);
  }

  private mark(name: string, vehicle: Vehicle) {
    let mark = this.marks.get(name);
    if (!mark) {
      const mesh = new THREE.Mesh(this.shape, new THREE.MeshBasicMaterial());
      const words = { name: make("span", {}, name), health: make("span", { class: "soft" }) };
      const label = make("div", { class: "label" }, words.name, words.health);
      mark = { mesh, label, ...words };
      this.marks.set(name, mark);
      this.group.add(mesh);
      this.labels.append(label);
    }
    (mark.mesh.material as THREE.MeshBasicMaterial).color.set(HEALTH[vehicle.health] ?? palette.health.good);
    mark.health.hidden = !vehicle.health || vehicle.health === "good";
    mark.health.textContent = vehicle.health && vehicle.health !== "good" ? vehicle.health : "";
    return mark;
  }
}

type Way = [number, number, number, number][];

function indexAt(way: Way, time_ms: number): number {
  let [low, high] = [0, way.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (way[middle][0] <= time_ms) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

function placeAt(way: Way, time_ms: number): [number, number, number, number] | null {
  const i = indexAt(way, time_ms);
  if (i < 0) return null;
  const [a, b] = [way[i], way[i + 1]];
  if (!b) return time_ms - a[0] > 30_000 ? null : a;
  const part = (time_ms - a[0]) / Math.max(b[0] - a[0], 1);
  return [time_ms, ...[1, 2, 3].map((c) => a[c] + part * (b[c] - a[c]))] as [number, number, number, number];
}

function headingAt(way: Way, time_ms: number): number | null {
  const i = Math.max(0, Math.min(indexAt(way, time_ms), way.length - 2));
  const [a, b] = [way[i], way[i + 1]];
  return a && b ? Math.atan2(b[2] - a[2], b[1] - a[1]) : null;
}

/** Layers of features: lines as lines, points as posts with a sign of their kind. */
export class Features {
  readonly group = new THREE.Group();
  private readonly layers = new Map<string, THREE.Group>();

  async show(layer: string, isShown: boolean): Promise<number> {
    const known = this.layers.get(layer);
    if (known) {
      known.visible = isShown;
      return known.children.length;
    }
    if (!isShown) return 0;
    const told = await ask<{ features: Feature[] }>(`features/${encodeURIComponent(layer)}`);
    const group = new THREE.Group();
    const points = told.features.filter((one) => one.points_m.length === 1);
    const lines = told.features.filter((one) => one.points_m.length > 1);
    if (points.length) group.add(...posts(points));
    if (lines.length) group.add(strokes(lines));
    this.layers.get(layer)?.removeFromParent();
    this.layers.set(layer, group);
    this.group.add(group);
    return told.features.length;
  }

  async renew(layer: string): Promise<void> {
    const known = this.layers.get(layer);
    if (!known) return;
    this.layers.delete(layer);
    known.removeFromParent();
    await this.show(layer, known.visible);
  }
}

const SYMBOLS: [RegExp, string, string][] = [
  [/sign/, "triangle", palette.change.new],
  [/light|lamp/, "disc", "#f7e26b"],
  [/pole|post/, "bar", palette.surface.other],
];

function symbol(shape: string, colour: string): THREE.Texture {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const c = canvas.getContext("2d")!;
  c.fillStyle = colour;
  c.strokeStyle = "#10212b";
  c.lineWidth = 6;
  c.beginPath();
  if (shape === "triangle") {
    c.moveTo(32, 7);
    c.lineTo(58, 54);
    c.lineTo(6, 54);
    c.closePath();
  } else if (shape === "bar") c.rect(22, 6, 20, 52);
  else c.arc(32, 32, 24, 0, 7);
  c.fill();
  c.stroke();
  return new THREE.CanvasTexture(canvas);
}

function posts(features: Feature[]): THREE.Object3D[] {
  const [, shape, colour] = SYMBOLS.find(([kind]) => kind.test(features[0].kind)) ?? ["", "disc", palette.surface.upright];
  const at = features.map((one) => one.points_m[0]);
  const heads = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(at.flat(), 3));
  const material = new THREE.PointsMaterial({ map: symbol(shape, colour), size: 22, sizeAttenuation: false, transparent: true, alphaTest: 0.4, depthTest: false });
  return [new THREE.Points(heads, material)];
}

function strokes(features: Feature[]): THREE.Object3D {
  const at: number[] = [];
  for (const one of features) {
    for (let i = 1; i < one.points_m.length; i++) {
      for (const p of [one.points_m[i - 1], one.points_m[i]]) at.push(p[0], p[1], p[2] + 0.15);
    }
  }
  const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: palette.surface.line }));
}

/** A frame of one metre around what is selected. */
export function selection(): THREE.LineSegments {
  // Lines are one pixel wide, however fine the screen is: some beside each other.
  const at = [1.12, 1.14, 1.16, 1.18].flatMap((side) => [...new THREE.EdgesGeometry(new THREE.BoxGeometry(side, side, side)).getAttribute("position").array]);
  const boxes = new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(at, 3));
  const mesh = new THREE.LineSegments(boxes, new THREE.LineBasicMaterial({ color: "#ffffff", depthTest: false }));
  mesh.visible = false;
  mesh.renderOrder = 5;
  return mesh;
}
