// The work list: what has changed, with pictures, and what whoever may decides about it.

import { ask, type About, type Change, type Decision, post, type WorkList as Told } from "./api";
import { palette } from "./colours";
import { byId, make, many, swatch, when } from "./dom";
import { HIGH, type Pictures, WIDE } from "./pictures";

const COLOURS: Record<string, string> = { new: palette.change.new, deleted: palette.change.deleted, modified: palette.change.modified };
const WORDS: Record<string, string> = { new: "New", deleted: "Deleted", modified: "Modified" };
const FILTERS = [["open", "Open"], ["new", "New"], ["deleted", "Deleted"], ["modified", "Modified"], ["accepted", "Accepted"]];

interface Judgement {
  name: string;
  word: string;
  done: string;
  says: string;
  needsWhy: boolean;
}

const JUDGEMENTS: Judgement[] = [
  { name: "accept", word: "Accept", done: "Accepted", needsWhy: false, says: "You have looked at it and it is right. The map stays as it is. When the change grows, it is open again." },
  {
    name: "doubt", word: "Doubt", done: "Doubted", needsWhy: true,
    says: "These voxels become what they were, and the reports behind them are doubted: what their vehicles alone claim in these tiles waits for others, until gnd release clear.",
  },
  { name: "roll_back", word: "Roll back", done: "Rolled back", needsWhy: true, says: "These voxels become what they were. Reports that came before count no more; what vehicles report from now on does." },
];

export class WorkList {
  private filter = "open";
  private readonly seen: IntersectionObserver;
  private readonly waiting = new Map<Element, () => void>();

  constructor(
    private readonly about: About,
    private readonly pictures: Pictures,
    private readonly go: (one: Change) => void,
    private readonly note: (text: string) => void,
  ) {
    this.seen = new IntersectionObserver((entries) => {
      for (const one of entries) {
        if (!one.isIntersecting) continue;
        this.seen.unobserve(one.target);
        this.waiting.get(one.target)?.();
        this.waiting.delete(one.target);
      }
    });
    byId("decidecancel").addEventListener("click", () => this.dialog.close());
  }

  private get holder(): HTMLElement {
    return byId("changes");
  }

  private get dialog(): HTMLDialogElement {
    return byId<HTMLDialogElement>("decide");
  }

  /** Reads the list; not while somebody is at it, unless they have just decided. */
  async read(isForced = false): Promise<void> {
    const told = await ask<Told>("changes");
    const isBusy = this.dialog.open || (this.holder.contains(document.activeElement) && this.holder.querySelector(".items"));
    if (isForced || !isBusy) this.show(told);
  }

  private show(told: Told): void {
    this.waiting.clear();
    this.seen.disconnect();
    const parts: Node[] = [];
    if (told.changes.length) parts.push(this.filters(told), this.items(this.chosen(told)));
    else parts.push(make("p", { class: "empty" }, "Nothing has changed since the survey."));
    const rest = [told.alone ? `${many(told.alone, "single voxel")} besides` : "", told.left_out ? `${told.left_out} smaller ones not listed` : ""].filter(Boolean);
    if (rest.length) parts.push(make("p", { class: "empty" }, rest.join("; ")));
    if (told.decided.length) parts.push(make("h2", {}, "Decided"), decisions(told.decided));
    this.holder.replaceChildren(...parts);
  }

  private chosen(told: Told, filter = this.filter): Change[] {
    if (filter === "accepted") return told.changes.filter((one) => one.accepted);
    return told.changes.filter((one) => !one.accepted && (filter === "open" || one.change === filter));
  }

  private filters(told: Told): HTMLElement {
    const holder = make("div", { class: "choices filters", role: "radiogroup", "aria-label": "Which changes" });
    for (const [key, word] of FILTERS) {
      const isOne = this.filter === key;
      const attributes = { type: "button", role: "radio", "aria-checked": String(isOne), tabindex: isOne ? "0" : "-1", "data-filter": key };
      const button = make("button", attributes, `${word} ${this.chosen(told, key).length}`);
      button.addEventListener("click", () => {
        this.filter = key;
        this.show(told);
        this.holder.querySelector<HTMLElement>(`[data-filter=${key}]`)?.focus();
      });
      holder.append(button);
    }
    return holder;
  }

  private items(changes: Change[]): HTMLElement {
    if (!changes.length) return make("p", { class: "empty" }, "None of these.");
    return make("ul", { class: "items" }, ...changes.map((one) => this.item(one)));
  }

  private item(one: Change): HTMLElement {
    const size = `${one.length_m.toFixed(1)} × ${one.width_m.toFixed(1)} × ${one.tall_m.toFixed(1)} m`;
    const who = one.vehicles === null ? "from a survey" : `${many(one.vehicles, "vehicle")}, ${many(one.reports, "report")}`;
    const head = make("span", { class: "head" }, swatch(COLOURS[one.change]), nameOf(one));
    const button = make("button", { type: "button", class: "item" }, head, make("span", { class: "soft num" }, `${size}, ${many(one.voxels, "voxel")}`, make("br"), who));
    button.addEventListener("click", () => this.go(one));
    const card = make("li", { class: "card" }, button);
    if (one.parts.length) button.append(this.shots(one));
    if (one.accepted) card.append(make("p", { class: "soft said" }, `Accepted by ${one.accepted.who}, ${when(one.accepted.at_ms)}${one.accepted.why ? `: ${one.accepted.why}` : ""}`));
    if (this.about.may_decide && one.key) card.append(this.buttons(one));
    return card;
  }

  private shots(one: Change): HTMLElement {
    const canvases = ["before", "after"].map((word) => [make("canvas", { width: String(2 * WIDE), height: String(2 * HIGH), "aria-hidden": "true" }), word] as const);
    const holder = make("span", { class: "shots" }, ...canvases.map(([canvas, word]) => make("span", { class: "shot" }, canvas, make("span", { class: "soft" }, word))));
    this.waiting.set(holder, () => void this.pictures.show(one, canvases[0][0], canvases[1][0]));
    this.seen.observe(holder);
    return holder;
  }

  private buttons(one: Change): HTMLElement {
    const buttons = JUDGEMENTS.filter((judgement) => !(judgement.name === "accept" && one.accepted) && !(judgement.name === "doubt" && !one.reports)).map((judgement) => {
      const button = make("button", { type: "button", class: "button", "aria-label": `${judgement.word}: ${nameOf(one)}, ${many(one.voxels, "voxel")}` }, judgement.word);
      button.addEventListener("click", () => this.askWhy(one, judgement));
      return button;
    });
    return make("div", { class: "decisions" }, ...buttons);
  }

  private askWhy(one: Change, judgement: Judgement): void {
    const why = byId<HTMLTextAreaElement>("decidewhy");
    const button = byId<HTMLButtonElement>("decideok");
    byId("decidetitle").textContent = `${judgement.word}: ${nameOf(one)}`;
    byId("decidesays").textContent = judgement.says;
    byId("decidewhylabel").textContent = judgement.needsWhy ? "Why, for who looks later" : "Why (if there is something to say)";
    why.value = "";
    const check = () => (button.disabled = judgement.needsWhy && !why.value.trim());
    why.oninput = check;
    check();
    button.textContent = judgement.word;
    button.onclick = () => void this.decide(one, judgement, why.value);
    this.dialog.showModal();
    why.focus();
  }

  private async decide(one: Change, judgement: Judgement, why: string): Promise<void> {
    byId<HTMLButtonElement>("decideok").disabled = true;
    try {
      await post(`changes/${one.key}`, { judgement: judgement.name, why });
      this.note(`${judgement.done}: ${nameOf(one)}.`);
    } catch (error) {
      this.note(`Not done: ${(error as Error).message}`);
    } finally {
      this.dialog.close();
      await this.read(true).catch((error) => this.note(`The list could not be read: ${error.message}`));
    }
  }
}

function nameOf(one: Change): string {
  return `${WORDS[one.change] ?? one.change} ${one.shape}`;
}

function decisions(decided: Decision[]): HTMLElement {
  const said = decided.map((one) =>
    make("li", {}, make("strong", {}, one.judgement), ` by ${one.who}`, make("div", { class: "soft num" }, when(one.at_ms)), one.why && make("div", {}, one.why)),
  );
  return make("ul", { class: "record" }, ...said);
}
