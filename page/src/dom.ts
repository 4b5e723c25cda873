// Small helpers of the document. Everything that comes from the server becomes text, never markup.

export function byId<T extends HTMLElement = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the document has no ${id}`);
  return found as T;
}

type Child = Node | string | null | undefined | false;

export function make<K extends keyof HTMLElementTagNameMap>(
  name: K,
  attributes: Record<string, string> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const one = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) one.setAttribute(key, value);
  for (const child of children) if (child) one.append(child);
  return one;
}

/** A square of a colour, drawn: the policy of the page allows no inline style. */
export function swatch(colour: string): HTMLElement {
  const one = make("i", { class: "swatch", "aria-hidden": "true" });
  one.style.background = colour;
  return one;
}

export function facts(rows: [string, Child][]): HTMLElement {
  const list = make("dl", { class: "facts" });
  for (const [name, value] of rows) list.append(make("dt", {}, name), make("dd", {}, value));
  return list;
}

export function when(ms: number): string {
  const at = new Date(ms);
  return Number.isNaN(at.getTime()) ? "–" : at.toISOString().replace("T", " ").slice(0, 19) + " UTC";
}

export function clock(ms: number): string {
  return new Date(ms).toISOString().slice(11, 19);
}

export function span(ms: number): string {
  const s = Math.max(0, ms / 1000);
  if (s < 90) return `${s.toFixed(0)} s`;
  if (s < 5400) return `${(s / 60).toFixed(0)} min`;
  if (s < 172_800) return `${(s / 3600).toFixed(0)} h`;
  return `${(s / 86_400).toFixed(0)} days`;
}

export function bytes(n: number): string {
  if (n < 1000) return `${n.toFixed(0)} B`;
  if (n < 1e6) return `${(n / 1e3).toFixed(1)} kB`;
  return `${(n / 1e6).toFixed(2)} MB`;
}

export function many(n: number, noun: string): string {
  return `${n.toLocaleString("en")} ${noun}${n === 1 ? "" : "s"}`;
}
