// Time: which moment is shown, which it is compared with, and playing on from there.

import { byId, clock, when } from "./dom";

const STEPS = 1000;

export class Timeline {
  /** When the map was first published; the line begins shortly before it changed. */
  survey_ms = 0;
  first_ms = 0;
  last_ms = 1;
  /** Infinity: whatever is newest. */
  after_ms = Infinity;
  before_ms = 0;
  private playing = false;
  private drawnAt_ms = 0;
  private times: number[] = [];
  private readonly after = byId<HTMLInputElement>("after");
  private readonly before = byId<HTMLInputElement>("before");
  private readonly ticks = byId<HTMLCanvasElement>("ticks");
  private readonly speed = byId<HTMLSelectElement>("speed");

  constructor(private readonly changed: () => void) {
    this.after.addEventListener("input", () => this.set(Number(this.after.value) >= STEPS ? Infinity : this.timeOf(this.after)));
    this.before.addEventListener("input", () => {
      this.before_ms = Number(this.before.value) === 0 ? this.survey_ms : this.timeOf(this.before);
      this.told();
    });
    byId("now").addEventListener("click", () => this.set(Infinity));
    byId("play").addEventListener("click", () => this.toggle());
    new ResizeObserver(() => this.drawTicks()).observe(this.ticks);
  }

  get isNewest(): boolean {
    return this.after_ms === Infinity;
  }

  get isPlaying(): boolean {
    return this.playing;
  }

  /** The moment that is shown, POSIX ms. */
  get shown_ms(): number {
    return this.isNewest ? this.last_ms : this.after_ms;
  }

  span(begin_ms: number, last_ms: number): void {
    this.last_ms = Math.max(last_ms, begin_ms + 1000);
    this.first_ms = begin_ms - 0.04 * (this.last_ms - begin_ms);
    this.told(true);
  }

  /** Make room for something that began and ended then. */
  hold(begin_ms: number, end_ms: number): void {
    if (begin_ms < this.first_ms) this.first_ms = begin_ms - 1000;
    this.last_ms = Math.max(this.last_ms, end_ms);
    this.told(true);
  }

  grow(ms: number): void {
    if (ms > this.last_ms) {
      this.last_ms = ms;
      this.told(true);
    }
  }

  marks(times: number[]): void {
    this.times = times;
    this.drawTicks();
  }

  set(ms: number, quietly = false): void {
    if (!quietly) this.stop();
    this.after_ms = ms >= this.last_ms && ms !== Infinity ? Infinity : ms;
    this.told();
  }

  toggle(): void {
    if (this.playing) this.stop();
    else this.play(Number(this.speed.value));
    this.told();
  }

  play(speed: number): void {
    const known = [...this.speed.options].some((one) => Number(one.value) === speed);
    if (!known) this.speed.add(new Option(`${speed}×`, String(speed)));
    this.speed.value = String(speed);
    if (this.isNewest) this.after_ms = this.first_ms;
    this.playing = true;
    this.drawnAt_ms = performance.now();
    this.told();
  }

  /** Moves time on; true while it plays. */
  advance(): boolean {
    if (!this.playing) return false;
    const now = performance.now();
    const next = this.after_ms + (now - this.drawnAt_ms) * Number(this.speed.value);
    this.drawnAt_ms = now;
    if (next >= this.last_ms) this.stop();
    this.set(next >= this.last_ms ? Infinity : next, true);
    return this.playing;
  }

  compare(isOn: boolean): void {
    byId("beforeline").hidden = !isOn;
    byId("aftername").textContent = isOn ? "After" : "Shown";
    this.drawTicks();
  }

  private stop(): void {
    this.playing = false;
  }

  private timeOf(input: HTMLInputElement): number {
    return this.first_ms + (Number(input.value) / STEPS) * (this.last_ms - this.first_ms);
  }

  private valueOf(ms: number): string {
    return String(ms === Infinity ? STEPS : Math.max(0, Math.round(((ms - this.first_ms) / (this.last_ms - this.first_ms)) * STEPS)));
  }

  private told(alsoTicks = false): void {
    this.after.value = this.valueOf(this.after_ms);
    this.before.value = this.valueOf(this.before_ms);
    this.after.setAttribute("aria-valuetext", this.isNewest ? "newest" : when(this.after_ms));
    this.before.setAttribute("aria-valuetext", this.before_ms <= this.survey_ms ? "survey" : when(this.before_ms));
    byId("clock").textContent = `${when(this.shown_ms).slice(0, 10)}\n${clock(this.shown_ms)} UTC`;
    byId("now").setAttribute("aria-pressed", String(this.isNewest));
    const play = byId("play");
    play.textContent = this.playing ? "Pause" : "Play";
    play.setAttribute("aria-pressed", String(this.playing));
    if (alsoTicks) this.drawTicks();
    this.changed();
  }

  /** How many versions were published when: a bar a pixel column. */
  private drawTicks(): void {
    const { clientWidth: width, clientHeight: height } = this.ticks;
    if (!width) return;
    const scale = Math.min(devicePixelRatio, 2);
    this.ticks.width = width * scale;
    this.ticks.height = height * scale;
    const c = this.ticks.getContext("2d")!;
    c.scale(scale, scale);
    const bars = new Array<number>(Math.ceil(width / 3)).fill(0);
    for (const at of this.times) {
      const part = (at - this.first_ms) / (this.last_ms - this.first_ms);
      if (part > 0.001 && part <= 1) bars[Math.min(Math.floor(part * bars.length), bars.length - 1)]++;
    }
    const most = Math.max(...bars, 1);
    c.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--accent");
    bars.forEach((n, i) => {
      if (n) c.fillRect(3 * i, height - Math.max(3, (n / most) * height), 2, height);
    });
  }
}
