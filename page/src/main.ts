// The page of `gnd serve`.

import * as THREE from "three";
import { ask, follow, type About, type Change, type Message, type Story, type Vehicle } from "./api";
import { legend, MODES, type Mode, palette, type Shades } from "./colours";
import { byId, facts, make, many, swatch, when } from "./dom";
import { looks } from "./gaussians";
import { Frame } from "./geodesy";
import { Features, Overview, selection, Vehicles } from "./overlays";
import { cloudPanel, fleetItems, trafficPanel, voxelPanel } from "./panels";
import { Pictures } from "./pictures";
import { type Hit, Tiles } from "./tiles";
import { Timeline } from "./timeline";
import { View } from "./view";
import { WorkList } from "./worklist";

const MODE_WORDS: Record<Mode, string> = { change: "Change", height: "Height", surface: "Surface", age: "Age", evidence: "Evidence" };
const THEMES = { dark: { map: "#0b1115", flash: "#ffffff" }, light: { map: "#e9eef1", flash: "#ff5a00" } };
const REFRESH_MS = 5000;

class Page {
  private readonly tiles: Tiles;
  private readonly view: View;
  private readonly vehicles: Vehicles;
  private readonly features = new Features();
  private readonly overview = new Overview();
  private readonly frame: Frame;
  private readonly timeline: Timeline;
  private readonly looks = looks();
  private readonly marker = selection();
  private readonly pictures: Pictures;
  private readonly work: WorkList;
  private mode: Mode = "change";
  private panel = "view";
  private isOpen = false;
  private isLive: boolean;
  private heightsAreFixed = false;
  private selected: { tile: number; voxel: number; version: number } | null = null;
  private hashTimer = 0;
  private arranged = 0;
  private slow = { frames: 0, since: 0 };
  private readonly shades: Shades;
  /** For measurements: when the last update was published, heard and drawn, POSIX ms. */
  readonly updates: { version: number; tile: number; created_ms: number; heard_ms: number; drawn_ms: number }[] = [];
  readonly began_ms = performance.now();
  readonly Place = THREE.Vector3;
  /** What `rate` has drawn in each frame. */
  rated = { tiles: 0, gaussians: 0 };
  firstPicture_ms = 0;

  constructor(private readonly about: About) {
    this.isLive = about.live;
    this.frame = new Frame(...about.origin_deg);
    this.shades = { mode: this.mode, low: about.ground_m - 2, high: about.ground_m + 12, from_s: about.first_ms / 1000, now_s: Date.now() / 1000 };
    this.tiles = new Tiles(about, this.looks, this.shades, () => this.rearrange(), (text) => this.note(text));
    this.vehicles = new Vehicles(byId("labels"));
    const after = [this.tiles.after.group, this.tiles.ghosts];
    this.view = new View(byId("map"), this.tiles.before.group, after, (now_s) => this.onFrame(now_s));
    this.view.scene.add(this.overview.group, this.vehicles.group, this.features.group, this.marker);
    this.timeline = new Timeline(() => this.onTime());
    this.pictures = new Pictures(this.view.renderer, this.looks, (info, version) => this.tiles.packedOf(info, version));
    this.work = new WorkList(about, this.pictures, (one) => this.goTo(one), (text) => this.note(text));
    this.begin();
  }

  private begin(): void {
    const { about } = this;
    byId("title").textContent = about.title;
    document.title = `${about.title}: live map`;
    this.theme(localStorage.getItem("gnd-theme") ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark"));
    this.tiles.before.time_ms = about.first_ms;
    this.timeline.survey_ms = about.first_ms;
    this.timeline.before_ms = about.first_ms;
    this.timeline.span(about.changed_ms || about.first_ms, about.last_ms);
    this.buildModes();
    this.buildLayers();
    this.wire();
    this.aboutPanel();
    this.badge();
    this.startPlace();
    if (about.tiles === 0) this.veil("empty", "This map has no tiles yet. They appear here as soon as there are any.");
    void this.guarded("The ground plan could not be read", this.overview.read(about).then(() => this.view.redraw()));
    void this.guarded("The vehicles could not be read", this.readVehicles());
    follow((message) => this.hear(message), (isOpen, isFirst) => this.onLine(isOpen, isFirst));
    window.setInterval(() => this.refreshPanel(), REFRESH_MS);
    if (about.replay > 0) this.timeline.play(about.replay);
  }

  // Where one looks

  private startPlace(): void {
    if (this.fromHash()) return;
    const [west, south, east, north] = this.about.extent_m;
    const widest = Math.max(east - west, north - south);
    const middle = widest > 1200 ? new THREE.Vector3(0, 0, this.about.ground_m) : new THREE.Vector3((west + east) / 2, (south + north) / 2, this.about.ground_m);
    this.lookAt(middle, Math.min(Math.max(0.7 * widest, 60), 700), false);
    if (this.about.changed_tiles) void this.guarded("", this.toFirstChange());
  }

  /** Begin where the map has changed most. */
  private async toFirstChange(): Promise<void> {
    const told = await ask<{ changes: Change[] }>("changes");
    if (told.changes.length && !this.view.isTouched) {
      const [x, y, z] = told.changes[0].at_m;
      this.lookAt(new THREE.Vector3(x, y, z), 70, false);
    }
  }

  private lookAt(target: THREE.Vector3, distance: number, isFlown: boolean): void {
    if (isFlown) return this.view.fly(target, distance);
    const eye = target.clone().add(new THREE.Vector3(-0.35, -0.62, 0.55).setLength(distance));
    this.view.place(target, eye);
  }

  private wholeMap(): void {
    const [west, south, east, north] = this.about.extent_m;
    const middle = new THREE.Vector3((west + east) / 2, (south + north) / 2, this.about.ground_m);
    this.view.fly(middle, Math.min(Math.max(0.9 * Math.max(east - west, north - south), 60), 12_000));
  }

  private fromHash(): boolean {
    const told = new URLSearchParams(location.hash.slice(1));
    const at = (told.get("at") ?? "").split(",").map(Number);
    if (MODES.includes(told.get("colour") as Mode)) this.setMode(told.get("colour") as Mode);
    if (at.length !== 6 || at.some((one) => !Number.isFinite(one)) || Math.abs(at[0]) > 90) return false;
    const target = new THREE.Vector3(...this.frame.toMap(at[0], at[1], at[2]));
    const [distance, bearing, tilt] = [Math.min(Math.max(at[3], 3), 15_000), (at[4] * Math.PI) / 180, (at[5] * Math.PI) / 180];
    const flat = distance * Math.cos(tilt);
    this.view.place(target, target.clone().add(new THREE.Vector3(-flat * Math.sin(bearing), -flat * Math.cos(bearing), distance * Math.sin(tilt))));
    const time = Number(told.get("time"));
    if (time > 0) this.timeline.set(time);
    const since = Number(told.get("before"));
    if (since > 0) {
      this.timeline.before_ms = since;
      this.compare(true);
    }
    return true;
  }

  private toHash(): void {
    window.clearTimeout(this.hashTimer);
    this.hashTimer = window.setTimeout(() => {
      const { target } = this.view.controls;
      const back = this.view.camera.position.clone().sub(target);
      const [lat, lon, up] = this.frame.toDegrees(target.toArray() as [number, number, number]);
      const bearing = (Math.atan2(-back.x, -back.y) * 180) / Math.PI;
      const tilt = (Math.asin(back.z / back.length()) * 180) / Math.PI;
      const told = [`at=${lat.toFixed(6)},${lon.toFixed(6)},${up.toFixed(1)},${back.length().toFixed(1)},${bearing.toFixed(1)},${tilt.toFixed(1)}`, `colour=${this.mode}`];
      if (!this.timeline.isNewest) told.push(`time=${Math.round(this.timeline.after_ms)}`);
      if (this.view.split !== null) told.push(`before=${Math.round(this.timeline.before_ms)}`);
      history.replaceState(null, "", `#${told.join("&")}`);
    }, 400);
  }

  // Drawing

  private rearrange(): void {
    this.arranged = 0;
    this.view.redraw();
  }

  private onFrame(now_s: number): void {
    this.looks.uniforms.uTime.value = now_s;
    this.looks.uniforms.uFocal.value = this.view.focal_px;
    if (this.timeline.advance()) this.view.keepDrawing(0.5);
    const { camera, controls } = this.view;
    const reach = Math.max(150, 1.6 * camera.position.distanceTo(controls.target));
    if (this.about.tiles) void this.tiles.lookAround(controls.target, reach);
    if (now_s - this.arranged > 0.12) {
      this.arranged = now_s;
      const isUnderway = this.tiles.arrange(camera.position);
      if (isUnderway) this.view.keepDrawing(0.3);
      this.loaded(isUnderway);
    } else this.view.keepDrawing(0.15);
    this.vehicles.draw(this.timeline.after_ms, camera, this.view.canvas.clientWidth, this.view.canvas.clientHeight);
    this.adapt(now_s);
    this.toHash();
  }

  /** A slow machine draws less finely, a quick one more. */
  private adapt(now_s: number): void {
    this.slow.frames++;
    const passed = now_s - this.slow.since;
    if (passed < 1) return;
    const rate = this.slow.frames / passed;
    const isContinuous = this.slow.frames > 3 && passed < 1.6;
    if (isContinuous && rate < 18) this.tiles.quality = Math.max(0.35, this.tiles.quality * 0.85);
    else if (isContinuous && rate > 45) this.tiles.quality = Math.min(2.5, this.tiles.quality * 1.1);
    this.slow = { frames: 0, since: now_s };
  }

  private loaded(isUnderway: boolean): void {
    const { drawn } = this.tiles;
    const left = this.tiles.leftOut ? `, ${this.tiles.leftOut} more tiles farther off` : "";
    byId("figures").textContent = drawn.tiles ? `${many(drawn.gaussians, "Gaussian")} in ${many(drawn.tiles, "tile")}${left}` : "";
    if (drawn.gaussians && !this.firstPicture_ms) {
      this.firstPicture_ms = performance.now() - this.began_ms;
      this.veil("", "");
    }
    const oldest = this.updates.find((one) => !one.drawn_ms);
    if (oldest) this.noteDrawn();
    if (!isUnderway && drawn.gaussians && !this.heightsAreFixed) {
      this.heightsAreFixed = true;
      [this.shades.low, this.shades.high] = this.tiles.heights();
      this.recolour();
    }
    if (!isUnderway) this.timeline.marks(this.tiles.times());
  }

  private noteDrawn(): void {
    for (const one of this.updates) {
      if (one.drawn_ms) continue;
      const slot = this.tiles.tiles.get(one.tile)?.slots[1];
      if ((slot?.loaded?.packed.version ?? 0) >= one.version) one.drawn_ms = Date.now();
    }
  }

  private recolour(): void {
    this.shades.mode = this.mode;
    this.shades.from_s = Math.floor(this.timeline.before_ms / 1000);
    this.shades.now_s = this.timeline.isNewest ? Date.now() / 1000 : this.timeline.after_ms / 1000;
    this.tiles.setShades({ ...this.shades });
    this.drawLegend();
  }

  private onTime(): void {
    this.tiles.after.time_ms = this.timeline.after_ms;
    this.tiles.before.time_ms = this.timeline.before_ms;
    const from_s = Math.floor(this.timeline.before_ms / 1000);
    if (from_s !== this.shades.from_s || this.mode === "age") this.recolour();
    byId("tagbefore").textContent = this.timeline.before_ms <= this.timeline.survey_ms ? "survey" : when(this.timeline.before_ms).slice(11, 19);
    byId("tagafter").textContent = this.timeline.isNewest ? "newest" : when(this.timeline.after_ms).slice(11, 19);
    if (this.timeline.isPlaying) this.view.keepDrawing(0.5);
    this.rearrange();
  }

  // What happens

  private hear(message: Message): void {
    switch (message.type) {
      case "update":
        if (message.tile) this.onUpdate(message.tile, message.before);
        else void this.guarded("A layer could not be read", this.features.renew(message.layer).then(() => this.view.redraw()));
        break;
      case "vehicles":
        this.vehicles.take(message.vehicles);
        for (const one of message.vehicles) if (one.at) this.timeline.grow(one.at[0]);
        if (this.panel === "fleet") this.fleetPanel();
        this.view.redraw();
        break;
      case "status":
        this.isLive = Boolean(message.status.live);
        this.badge();
        if (this.panel === "cloud") byId("cloud").replaceChildren(...cloudPanel(message.status));
        break;
      case "ended":
        this.isLive = false;
        this.badge();
        this.note("The run has ended. Its map stays here.");
        break;
      case "decided":
        if (this.panel === "changes") void this.guarded("The changes could not be read", this.work.read());
        break;
      case "reload":
        void this.catchUp();
        break;
    }
  }

  private onUpdate(info: import("./api").TileInfo, before: number): void {
    const created_ms = info.versions[info.versions.length - 1][1];
    this.updates.push({ version: info.version, tile: info.id, created_ms, heard_ms: Date.now(), drawn_ms: 0 });
    if (this.updates.length > 1000) this.updates.shift();
    this.timeline.grow(created_ms);
    if (this.about.tiles === 0) return location.reload();
    void this.tiles.update(info, before).then(() => {
      this.view.keepDrawing(3);
      this.timeline.marks(this.tiles.times());
    });
  }

  private onLine(isOpen: boolean, isFirst: boolean): void {
    this.isOpen = isOpen;
    this.badge();
    if (isOpen && !isFirst) void this.catchUp();
  }

  /** What was missed is read anew; another map than before is another page. */
  private async catchUp(): Promise<void> {
    await this.guarded("The map could not be read", (async () => {
      const now = await ask<About>("map");
      if (now.key !== this.about.key) return location.reload();
      this.isLive = now.live;
      this.timeline.grow(now.last_ms);
      await this.tiles.lookAround(this.view.controls.target, 300, true);
      await this.readVehicles();
      this.badge();
    })());
  }

  private async readVehicles(): Promise<void> {
    const [known, ways] = await Promise.all([ask<Vehicle[]>("vehicles"), ask<Vehicles["ways"]>("ways")]);
    this.vehicles.ways = ways;
    this.vehicles.take(known);
    for (const way of Object.values(ways)) if (way.length) this.timeline.hold(way[0][0], way[way.length - 1][0]);
    this.view.redraw();
  }

  private badge(): void {
    const badge = byId("badge");
    badge.dataset.state = !this.isOpen ? "lost" : this.isLive ? "live" : "recorded";
    badge.textContent = !this.isOpen ? "connecting …" : this.isLive ? "live" : "recorded";
  }

  private async guarded(what: string, work: Promise<unknown>): Promise<void> {
    try {
      await work;
    } catch (error) {
      if (what) this.note(`${what}: ${(error as Error).message}`);
    }
  }

  private noteTimer = 0;
  private note(text: string): void {
    const note = byId("note");
    note.textContent = text;
    note.hidden = false;
    window.clearTimeout(this.noteTimer);
    this.noteTimer = window.setTimeout(() => (note.hidden = true), 8000);
  }

  private veil(state: string, text: string): void {
    showVeil(state, text);
  }

  // Selecting

  private pick(event: { clientX: number; clientY: number }): void {
    const box = this.view.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2((x / box.width) * 2 - 1, 1 - (y / box.height) * 2), this.view.camera);
    const isBefore = this.view.split !== null && x < this.view.split * box.width;
    const hit = this.tiles.pick(ray.ray, isBefore);
    if (hit) void this.select(hit);
    else this.unselect();
  }

  private async select(hit: Hit): Promise<void> {
    const voxel = hit.packed.voxel[hit.row];
    this.selected = { tile: hit.tile.id, voxel, version: hit.version };
    this.marker.position.copy(hit.at);
    this.marker.visible = true;
    this.view.redraw();
    const body = byId("inspectbody");
    body.replaceChildren(make("p", { class: "empty" }, "Reading its history …"));
    byId("inspect").hidden = false;
    try {
      const story = await ask<Story>(`voxel/${hit.tile.id}/${voxel}?version=${hit.version}`);
      if (this.selected?.voxel === voxel) body.replaceChildren(...voxelPanel(story));
    } catch (error) {
      body.replaceChildren(make("p", { class: "empty" }, `Its history could not be read: ${(error as Error).message}`));
    }
  }

  private unselect(): void {
    this.selected = null;
    this.marker.visible = false;
    byId("inspect").hidden = true;
    this.view.redraw();
  }

  // Before and after

  private compare(isOn: boolean): void {
    this.view.split = isOn ? 0.5 : null;
    this.tiles.comparing = isOn;
    byId("divider").hidden = !isOn;
    byId("compare").setAttribute("aria-pressed", String(isOn));
    this.timeline.compare(isOn);
    this.divide(0.5);
    this.rearrange();
  }

  private divide(share: number): void {
    const divider = byId("divider");
    const part = Math.min(Math.max(share, 0.02), 0.98);
    if (this.view.split !== null) this.view.split = part;
    divider.style.left = `${(100 * part).toFixed(2)}%`;
    divider.setAttribute("aria-valuenow", String(Math.round(100 * part)));
    this.view.redraw();
  }

  // Panels

  private open(name: string): void {
    this.panel = name;
    for (const tab of document.querySelectorAll<HTMLElement>("[role=tab]")) {
      const isOne = tab.id === `tab-${name}`;
      tab.setAttribute("aria-selected", String(isOne));
      tab.tabIndex = isOne ? 0 : -1;
      byId(tab.getAttribute("aria-controls")!).hidden = !isOne;
    }
    this.refreshPanel(true);
  }

  private refreshPanel(isNew = false): void {
    if (!isNew && (document.hidden || !this.isLive)) return;
    const reading: Record<string, () => Promise<void>> = {
      changes: () => this.work.read(isNew),
      traffic: async () => byId("traffic").replaceChildren(...trafficPanel(await ask("traffic"))),
      cloud: async () => byId("cloud").replaceChildren(...cloudPanel(await ask("status"))),
      fleet: async () => this.fleetPanel(),
    };
    const work = reading[this.panel];
    if (!work) return;
    const holder = byId(this.panel);
    if (!holder.childElementCount) holder.append(make("p", { class: "empty" }, "Reading …"));
    work().catch((error) => holder.replaceChildren(make("p", { class: "empty" }, `This could not be read: ${error.message}`)));
  }

  private fleetPanel(): void {
    const known = [...this.vehicles.known.values()].sort((a, b) => a.name.localeCompare(b.name));
    const holder = byId("fleet");
    if (holder.contains(document.activeElement)) return; // not under somebody's fingers
    holder.replaceChildren(
      fleetItems(known, (one) => {
        if (one.at) this.view.fly(new THREE.Vector3(one.at[1], one.at[2], one.at[3]), 60);
      }),
    );
  }

  private goTo(one: Change): void {
    const [x, y, z] = one.at_m;
    this.view.fly(new THREE.Vector3(x, y, z + one.tall_m / 2), Math.max(18, 2.2 * Math.max(one.length_m, one.tall_m)));
    if (innerWidth <= 820) this.side(false);
  }

  private aboutPanel(): void {
    const { about } = this;
    byId("about").replaceChildren(
      facts([
        ["Tiles", about.tiles.toLocaleString("en")],
        ["of these changed", about.changed_tiles.toLocaleString("en")],
        ["Layer", about.layer],
        ["Origin", `${about.origin_deg[0].toFixed(5)}°, ${about.origin_deg[1].toFixed(5)}°`],
        ["First version", about.first_ms ? when(about.first_ms) : "–"],
        ["You", `${about.viewer}, ${about.may_decide ? "may decide about changes" : "looks only"}`],
      ]),
    );
  }

  private buildModes(): void {
    const holder = byId("modes");
    for (const mode of MODES) {
      const button = make("button", { type: "button", role: "radio", "data-mode": mode }, MODE_WORDS[mode]);
      button.addEventListener("click", () => this.setMode(mode));
      holder.append(button);
    }
    this.setMode(this.mode);
  }

  private setMode(mode: Mode): void {
    this.mode = mode;
    for (const button of document.querySelectorAll<HTMLElement>("[data-mode]")) {
      const isOne = button.dataset.mode === mode;
      button.setAttribute("aria-checked", String(isOne));
      button.tabIndex = isOne ? 0 : -1;
    }
    this.recolour();
  }

  private drawLegend(): void {
    const told = legend(this.shades);
    const holder = byId("legend");
    holder.replaceChildren(make("div", { class: "soft" }, told.title));
    if (told.ends) {
      const canvas = make("canvas", { width: "256", height: "1", role: "img", "aria-label": `From ${told.ends[0]} to ${told.ends[1]}` });
      const c = canvas.getContext("2d")!;
      const ramp = c.createLinearGradient(0, 0, 256, 0);
      palette.ramp.forEach((colour, i) => ramp.addColorStop(i / (palette.ramp.length - 1), colour));
      c.fillStyle = ramp;
      c.fillRect(0, 0, 256, 1);
      holder.append(canvas, make("div", { class: "ends" }, make("span", {}, told.ends[0]), make("span", {}, told.ends[1])));
    }
    for (const [colour, word] of told.classes) holder.append(make("div", { class: "class" }, swatch(colour), word));
  }

  private buildLayers(): void {
    const holder = byId("layers");
    const add = (word: string, isOn: boolean, change: (isOn: boolean) => void) => {
      const box = make("input", { type: "checkbox" });
      box.checked = isOn;
      box.addEventListener("change", () => {
        change(box.checked);
        this.rearrange();
      });
      holder.append(make("label", {}, box, make("span", {}, word)));
    };
    add("Vehicles", true, (isOn) => (this.vehicles.isShown = isOn));
    add("Deleted voxels as ghosts", true, (isOn) => (this.tiles.showGhosts = isOn));
    add("Ground plan of all tiles", true, (isOn) => (this.overview.group.visible = isOn));
    for (const layer of this.about.feature_layers) {
      const show = (isOn: boolean) => void this.guarded(`The layer ${layer} could not be read`, this.features.show(layer, isOn).then(() => this.view.redraw()));
      add(layer[0].toUpperCase() + layer.slice(1), true, show);
      show(true);
    }
  }

  private theme(name: string): void {
    const theme = name === "light" ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    byId("theme").textContent = theme === "dark" ? "Light" : "Dark";
    this.looks.uniforms.uFlash.value.set(THEMES[theme].flash);
    (this.marker.material as THREE.LineBasicMaterial).color.set(theme === "dark" ? "#ffffff" : "#000000");
    this.view.background(THEMES[theme].map);
    this.overview.tint(new THREE.Color(THEMES[theme].map));
    this.timeline.marks(this.tiles.times());
  }

  private side(isOpen: boolean): void {
    byId("side").classList.toggle("open", isOpen);
    byId("sidebutton").setAttribute("aria-expanded", String(isOpen));
  }

  private wire(): void {
    byId("compare").addEventListener("click", () => this.compare(this.view.split === null));
    byId("home").addEventListener("click", () => this.wholeMap());
    byId("theme").addEventListener("click", () => {
      const theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
      localStorage.setItem("gnd-theme", theme);
      this.theme(theme);
    });
    byId("inspectclose").addEventListener("click", () => this.unselect());
    byId("sidebutton").addEventListener("click", () => this.side(!byId("side").classList.contains("open")));
    this.wireTabs();
    this.wireRadios();
    this.wireDivider();
    this.wireMap();
    window.addEventListener("hashchange", () => this.fromHash());
    document.addEventListener("keydown", (event) => this.key(event));
  }

  private key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const isTyping = (event.target as HTMLElement).closest("input, select, textarea, button, dialog, [role=tab]");
    if (event.key === "Escape") this.unselect();
    if (isTyping) return;
    if (event.key.toLowerCase() === "b") this.compare(this.view.split === null);
    if (event.key === " ") {
      event.preventDefault();
      this.timeline.toggle();
    }
  }

  private wireTabs(): void {
    const tabs = [...document.querySelectorAll<HTMLElement>("[role=tab]")];
    tabs.forEach((tab, i) => {
      tab.addEventListener("click", () => this.open(tab.id.slice(4)));
      tab.addEventListener("keydown", (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        const next = tabs[(i + step + tabs.length) % tabs.length];
        next.focus();
        this.open(next.id.slice(4));
      });
    });
  }

  /** Arrow keys go from one choice to the next. */
  private wireRadios(): void {
    document.addEventListener("keydown", (event) => {
      const radio = (event.target as HTMLElement).closest<HTMLElement>("[role=radio]");
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!radio || !step) return;
      event.preventDefault();
      const all = [...radio.parentElement!.querySelectorAll<HTMLElement>("[role=radio]")];
      const next = all[(all.indexOf(radio) + step + all.length) % all.length];
      next.focus();
      next.click();
    });
  }

  private wireDivider(): void {
    const divider = byId("divider");
    divider.addEventListener("pointerdown", (event) => {
      divider.setPointerCapture(event.pointerId);
      event.preventDefault();
      divider.focus();
    });
    divider.addEventListener("pointermove", (event) => {
      if (!divider.hasPointerCapture(event.pointerId)) return;
      const box = byId("map").getBoundingClientRect();
      this.divide((event.clientX - box.left) / box.width);
    });
    divider.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 0.02, ArrowUp: 0.02, ArrowLeft: -0.02, ArrowDown: -0.02 }[event.key];
      if (step && this.view.split !== null) {
        event.preventDefault();
        this.divide(this.view.split + step);
      }
    });
  }

  /** A click without a drag selects. */
  private wireMap(): void {
    let down: { x: number; y: number } | null = null;
    this.view.canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary && event.button === 0 ? { x: event.clientX, y: event.clientY } : null));
    this.view.canvas.addEventListener("pointerup", (event) => {
      if (down && Math.hypot(event.clientX - down.x, event.clientY - down.y) < 4) this.pick(event);
      down = null;
    });
  }

  /** For measurements and tests: what is drawn, and frames a second when every frame is drawn. */
  get state() {
    const { drawn } = this.tiles;
    return { ...drawn, isLoading: this.tiles.isLoading, quality: this.tiles.quality, firstPicture_ms: this.firstPicture_ms, updates: this.updates, selected: this.selected, live: this.isLive, open: this.isOpen, split: this.view.split, time_ms: this.timeline.after_ms, vehicles: [...this.vehicles.known.keys()] };
  }

  /** Frames a second when every frame is drawn as these distances say (m, see `Tiles`). */
  async rate(seconds: number, reach: Partial<Pick<Tiles, "near_m" | "disc_m" | "fine_m" | "block_m">> = {}): Promise<number> {
    const { near_m, disc_m, fine_m, block_m, quality } = this.tiles;
    const gl = this.view.renderer.getContext();
    const pixel = new Uint8Array(4);
    this.view.isPaused = true;
    const frame = async (isAnew = false) => {
      Object.assign(this.tiles, reach, { quality: 1 });
      if (isAnew) this.arranged = 0;
      this.view.draw();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // until it is really drawn
      await new Promise((resolve) => setTimeout(resolve, 0));
    };
    do await frame(true);
    while (this.tiles.isLoading);
    const begin = performance.now();
    let n = 0;
    for (; performance.now() - begin < 1000 * seconds; n++) await frame();
    const rate = (1000 * n) / (performance.now() - begin);
    this.rated = { ...this.tiles.drawn };
    Object.assign(this.tiles, { near_m, disc_m, fine_m, block_m, quality });
    this.view.isPaused = false;
    return rate;
  }
}

function showVeil(state: string, text: string): void {
  const veil = byId("veil");
  veil.hidden = !text;
  veil.dataset.state = state;
  byId("veiltext").textContent = text;
}

async function start(): Promise<void> {
  if (!document.createElement("canvas").getContext("webgl2")) {
    showVeil("failed", "This browser does not draw WebGL 2, which the map needs. Try another browser, or switch hardware acceleration on.");
    return;
  }
  const about = await patiently();
  try {
    (window as any).gndPage = new Page(about);
  } catch (error) {
    console.error(error);
    showVeil("failed", `The map cannot be drawn: ${(error as Error).message}`);
  }
}

async function patiently(): Promise<About> {
  for (let pause_ms = 500; ; pause_ms = Math.min(2 * pause_ms, 5000)) {
    try {
      return await ask<About>("map");
    } catch (error) {
      showVeil("failed", `The map cannot be read: ${(error as Error).message}. Trying again …`);
      await new Promise((resolve) => setTimeout(resolve, pause_ms));
    }
  }
}

void start();
