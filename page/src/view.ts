// The window onto the map: camera, controls, what is drawn when.

import * as THREE from "three";
import { MapControls } from "three/addons/controls/MapControls.js";

export class View {
  readonly scene = new THREE.Scene();
  readonly camera = new THREE.PerspectiveCamera(50, 1, 0.3, 30_000);
  readonly renderer: THREE.WebGLRenderer;
  readonly controls: MapControls;
  /** Share of the window left of the divider; null: nothing is compared. */
  split: number | null = null;
  frames = 0;
  /** For measurements: nothing is drawn but by `draw`. */
  isPaused = false;
  /** Whether somebody has moved the view. */
  isTouched = false;
  private isDirty = true;
  private flight: { from: THREE.Vector3; to: THREE.Vector3; eyeFrom: THREE.Vector3; eyeTo: THREE.Vector3; begin: number } | null = null;
  private busyUntil = 0;
  private readonly calm = matchMedia("(prefers-reduced-motion: reduce)");

  constructor(
    private readonly holder: HTMLElement,
    private readonly before: THREE.Object3D,
    private readonly after: THREE.Object3D[],
    private readonly onFrame: (now_s: number) => void,
  ) {
    this.renderer = new THREE.WebGLRenderer({ antialias: false, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.autoClear = false;
    holder.prepend(this.renderer.domElement);
    const canvas = this.renderer.domElement;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-label", "Map. Arrow keys move, plus and minus zoom, Q and E turn, R and F tilt.");
    this.camera.up.set(0, 0, 1);
    this.controls = new MapControls(this.camera, canvas);
    this.controls.maxPolarAngle = Math.PI * 0.495;
    this.controls.minDistance = 3;
    this.controls.maxDistance = 15_000;
    this.controls.enableDamping = false;
    this.controls.screenSpacePanning = false;
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.redraw());
    this.controls.addEventListener("start", () => this.touch());
    this.scene.add(before, ...after);
    new ResizeObserver(() => this.resize()).observe(holder);
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.redraw());
    this.resize();
    requestAnimationFrame(() => this.loop());
  }

  get canvas(): HTMLCanvasElement {
    return this.renderer.domElement;
  }

  /** Pixels that 1 m is high at a distance of 1 m. */
  get focal_px(): number {
    return 0.5 * this.canvas.height * this.camera.projectionMatrix.elements[5];
  }

  redraw(): void {
    this.isDirty = true;
  }

  /** Draw every frame for a while: something moves by itself. */
  keepDrawing(seconds: number): void {
    this.busyUntil = Math.max(this.busyUntil, performance.now() + 1000 * seconds);
  }

  background(colour: string): void {
    this.renderer.setClearColor(new THREE.Color(colour));
    this.redraw();
  }

  place(target: THREE.Vector3, eye: THREE.Vector3): void {
    this.flight = null;
    this.controls.target.copy(target);
    this.camera.position.copy(eye);
    this.controls.update();
    this.redraw();
  }

  /** Fly to a place so that it is seen from `distance` m, in the direction that one looks already. */
  fly(target: THREE.Vector3, distance: number): void {
    this.isTouched = true;
    const from = this.controls.target.clone();
    const back = this.camera.position.clone().sub(from);
    back.setLength(distance);
    const least = 0.55 * distance;
    if (back.z < least) back.z = least;
    const eyeTo = target.clone().add(back.setLength(distance));
    if (this.calm.matches) {
      this.place(target, eyeTo);
      return;
    }
    this.flight = { from, to: target.clone(), eyeFrom: this.camera.position.clone(), eyeTo, begin: performance.now() };
    this.keepDrawing(0.8);
  }

  private resize(): void {
    const { clientWidth, clientHeight } = this.holder;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.redraw();
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const offset = this.camera.position.clone().sub(this.controls.target);
    const step = 0.12 * offset.length();
    const forward = new THREE.Vector3(-offset.x, -offset.y, 0).normalize();
    const right = new THREE.Vector3(forward.y, -forward.x, 0);
    const turn = new THREE.Spherical().setFromVector3(new THREE.Vector3(offset.x, offset.z, -offset.y));
    const moves: Record<string, () => void> = {
      ArrowUp: () => this.move(forward.multiplyScalar(step)),
      ArrowDown: () => this.move(forward.multiplyScalar(-step)),
      ArrowRight: () => this.move(right.multiplyScalar(step)),
      ArrowLeft: () => this.move(right.multiplyScalar(-step)),
      "+": () => (turn.radius *= 0.8),
      "=": () => (turn.radius *= 0.8),
      "-": () => (turn.radius *= 1.25),
      q: () => (turn.theta -= 0.15),
      e: () => (turn.theta += 0.15),
      r: () => (turn.phi -= 0.1),
      f: () => (turn.phi += 0.1),
    };
    const move = moves[event.key] ?? moves[event.key.toLowerCase()];
    if (!move) return;
    event.preventDefault();
    this.touch();
    move();
    turn.radius = Math.min(Math.max(turn.radius, this.controls.minDistance), this.controls.maxDistance);
    turn.phi = Math.min(Math.max(turn.phi, 0.02), this.controls.maxPolarAngle);
    const v = new THREE.Vector3().setFromSpherical(turn);
    this.camera.position.copy(this.controls.target).add(new THREE.Vector3(v.x, -v.z, v.y));
    this.controls.update();
    this.redraw();
  }

  private touch(): void {
    this.isTouched = true;
    this.flight = null;
  }

  private move(by: THREE.Vector3): void {
    this.controls.target.add(by);
  }

  private loop(): void {
    requestAnimationFrame(() => this.loop());
    this.advance();
    const isBusy = performance.now() < this.busyUntil;
    if (this.isPaused || (!this.isDirty && !isBusy)) return;
    this.isDirty = false;
    this.draw();
  }

  private advance(): void {
    if (!this.flight) return;
    const part = Math.min(1, (performance.now() - this.flight.begin) / 700);
    const eased = part * part * (3 - 2 * part);
    this.controls.target.lerpVectors(this.flight.from, this.flight.to, eased);
    this.camera.position.lerpVectors(this.flight.eyeFrom, this.flight.eyeTo, eased);
    this.controls.update();
    if (part === 1) this.flight = null;
    this.redraw();
  }

  draw(): void {
    const far = this.camera.position.distanceTo(this.controls.target);
    this.camera.near = Math.min(Math.max(far / 200, 0.2), 5);
    this.camera.updateProjectionMatrix();
    this.onFrame(performance.now() / 1000);
    const size = this.renderer.getSize(new THREE.Vector2());
    this.renderer.setScissorTest(false);
    this.renderer.clear();
    if (this.split === null) this.pass(false, 0, size.x, size);
    else {
      const at = Math.round(this.split * size.x);
      this.pass(true, 0, at, size);
      this.pass(false, at, size.x - at, size);
    }
    this.frames++;
  }

  private pass(isBefore: boolean, x: number, width: number, size: THREE.Vector2): void {
    this.before.visible = isBefore;
    for (const one of this.after) one.visible = !isBefore;
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(x, 0, width, size.y);
    this.renderer.render(this.scene, this.camera);
  }
}
