// The bar that selects the time span of all plots: usual lengths, a free range, and the export.

import { dateOf } from "./course.js";
import { h, setText } from "./dom.js";
import { t } from "./language.js";
import { saved } from "./samples.js";
import { LENGTHS } from "./span.js";
import { asTimeField, duration, fieldOf, isWithoutDate, time, timeOfField, zone } from "./words.js";

/**
 * Writes times (s) into fields, and the zone or the unit beside them. A record without dates has times
 * in seconds.
 */
export function showTimes(fields, times, zoneText) {
  const isRecord = isWithoutDate(times.at(-1));
  fields.forEach((field, index) => {
    if (isRecord) [field.type, field.step] = ["number", "any"];
    else asTimeField(field);
    field.value = isRecord ? String(Number(times[index].toFixed(3))) : fieldOf(times[index]);
  });
  setText(zoneText, isRecord ? "s" : zone(times.at(-1)));
}

/** Returns the time in a field of a range (s), or NaN without one. */
export function timeIn({ type, value }) {
  return type === "number" ? (value === "" ? NaN : Number(value)) : timeOfField(value);
}

/** Returns a text that data are missing, because the history was late, with a button that loads them. */
export function lateNotice(again) {
  return h("p", { class: "told", role: "status" }, t("history-did-not-answer-in-time"), " ", h("button", { type: "button", class: "small", onclick: again }, t("load-again")));
}

export class RangeBar {
  /**
   * `csv()` returns the address of the visible data of all plots, and `report()` that of a report of the
   * range. `samples` exports the samples of the range. `key` begins the identifiers of the fields,
   * `live` names what the span without a range shows, and `label` the bar for a screen reader. `isOfDays`
   * states whether the data are those of days (UTC).
   */
  constructor(span, csv, { lengths = LENGTHS, key = "range", report = null, samples = null, live = null, label = t("span-of-all-plots"), isOfDays = false } = {}) {
    Object.assign(this, { span, live, isOfDays });
    const free = key === "range" ? "free-range" : `${key}-free-range`;
    this.buttons = lengths.map(([length, text]) => {
      const button = h("button", { type: "button", onclick: () => span.live(length) }, text);
      return { length, button };
    });
    this.zoomed = h("button", { type: "button", class: "back", onclick: () => span.live(span.length_s) }, t("back-to-live"));
    this.text = h("span", { class: "range-text", role: "status" });
    this.late = lateNotice(() => span.again());
    this.opener = h("button", { type: "button", class: "free", "aria-expanded": "false", "aria-controls": free, onclick: () => this.#toggle() }, t("from-to"));
    this.from = h("input", { id: `${key}-from`, required: true });
    this.to = h("input", { id: `${key}-to`, required: true });
    this.zone = h("span");
    this.told = h("span", { class: "told", role: "status" });
    this.form = h(
      "form",
      { class: "free-range", id: free, hidden: true, onsubmit: (event) => this.#submit(event) },
      h("label", { for: `${key}-from` }, t("from")),
      this.from,
      h("label", { for: `${key}-to` }, t("to")),
      this.to,
      this.zone,
      h("button", { type: "submit" }, t("show")),
      csv ? h("a", { class: "button", href: "#", download: "", onclick: (event) => this.#save(event, csv()) }, t("csv-of-all-plots")) : null,
      report ? h("a", { class: "button", href: "#", onclick: (event) => (event.currentTarget.href = report()) }, t("report")) : null,
      this.told,
      samples ? h("span", {}, t("samples"), " ", samples) : null,
    );
    this.element = h("div", { class: "ranges-bar" }, h("div", { class: "ranges", role: "group", "aria-label": label }, this.buttons.map(({ button }) => button), this.opener), h("div", { class: "range-state" }, this.zoomed, this.text, this.late), this.form);
    this.update();
  }

  update() {
    const { span } = this;
    for (const { length, button } of this.buttons) button.setAttribute("aria-pressed", String(span.isLive && span.length_s === length));
    this.zoomed.hidden = span.isLive;
    this.late.hidden = span.late.size === 0;
    setText(this.text, this.#words());
  }

  #toggle() {
    this.form.hidden = !this.form.hidden;
    this.opener.setAttribute("aria-expanded", String(!this.form.hidden));
    if (this.form.hidden) return;
    const { min, max } = this.span.shown;
    showTimes([this.from, this.to], [min, max], this.zone);
    setText(this.told, "");
    this.from.focus();
  }

  /** Saves the data of all plots. If the server refuses them, the reason is shown beside the link. */
  async #save(event, address) {
    event.currentTarget.href = address;
    if (!address.startsWith("/api/")) return;
    event.preventDefault();
    setText(this.told, await saved(address));
  }

  #submit(event) {
    event.preventDefault();
    const [from, to] = [this.from, this.to].map(timeIn);
    if (!(to > from)) return setText(this.told, t("end-after-start"));
    setText(this.told, "");
    this.span.fix(from, to);
  }

  /** Returns what a span without a range shows. The newest day can be an old one. */
  #newest(at) {
    const { newest_s: newest } = this.span;
    if (newest === null) return t("no-data");
    return this.isOfDays ? t("newest-data-at", at(newest)) : t("newest-data");
  }

  #words() {
    const { span } = this;
    const at = this.isOfDays ? dateOf : time;
    const kept = span.lacks ? t("kept-since", at(span.keptFrom_s)) : "";
    return (span.isLive ? (this.live ?? this.#newest(at)) : `${at(span.from_s)} – ${at(span.to_s)} (${duration(span.to_s - span.from_s)})`) + kept;
  }
}
