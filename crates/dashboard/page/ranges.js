// The bar that selects the time span of all plots: usual lengths, a free range, and the export.

import { h, setText } from "./dom.js";
import { t } from "./language.js";
import { LENGTHS } from "./span.js";
import { duration, fieldOf, isWithoutDate, time, timeOfField, zone } from "./words.js";

export class RangeBar {
  /**
   * `csv()` returns the address of the visible data of all plots, and `report()` that of a report of the
   * range. `samples` exports the samples of the range. `key` begins the identifiers of the fields.
   */
  constructor(span, csv, { lengths = LENGTHS, key = "range", report = null, samples = null } = {}) {
    this.span = span;
    const free = key === "range" ? "free-range" : `${key}-free-range`;
    this.buttons = lengths.map(([length, text]) => {
      const button = h("button", { type: "button", onclick: () => span.live(length) }, text);
      return { length, button };
    });
    this.zoomed = h("button", { type: "button", class: "back", onclick: () => span.live(span.length_s) }, t("back-to-live"));
    this.text = h("span", { class: "range-text", role: "status" });
    this.opener = h("button", { type: "button", class: "free", "aria-expanded": "false", "aria-controls": free, onclick: () => this.#toggle() }, t("from-to"));
    this.from = h("input", { type: "datetime-local", step: 1, id: `${key}-from`, required: true });
    this.to = h("input", { type: "datetime-local", step: 1, id: `${key}-to`, required: true });
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
      h("a", { class: "button", href: "#", download: "", onclick: (event) => (event.currentTarget.href = csv()) }, t("csv-of-all-plots")),
      report ? h("a", { class: "button", href: "#", onclick: (event) => (event.currentTarget.href = report()) }, t("report")) : null,
      this.told,
      samples ? h("span", {}, t("samples"), " ", samples) : null,
    );
    this.element = h("div", { class: "ranges-bar" }, h("div", { class: "ranges", role: "group", "aria-label": t("span-of-all-plots") }, this.buttons.map(({ button }) => button), this.opener), h("div", { class: "range-state" }, this.zoomed, this.text), this.form);
    this.update();
  }

  update() {
    const { span } = this;
    for (const { length, button } of this.buttons) button.setAttribute("aria-pressed", String(span.isLive && span.length_s === length));
    this.zoomed.hidden = span.isLive;
    this.opener.hidden = isWithoutDate(span.to_s);
    setText(this.text, this.#words());
  }

  #toggle() {
    this.form.hidden = !this.form.hidden;
    this.opener.setAttribute("aria-expanded", String(!this.form.hidden));
    if (this.form.hidden) return;
    const { min, max } = this.span.shown;
    [this.from.value, this.to.value] = [fieldOf(min), fieldOf(max)];
    setText(this.zone, zone(max));
    setText(this.told, "");
    this.from.focus();
  }

  #submit(event) {
    event.preventDefault();
    const [from, to] = [timeOfField(this.from.value), timeOfField(this.to.value)];
    if (!(to > from)) return setText(this.told, t("end-after-start"));
    setText(this.told, "");
    this.span.fix(from, to);
  }

  #words() {
    const { span } = this;
    const kept = span.lacks ? t("kept-since", time(span.keptFrom_s)) : "";
    return (span.isLive ? t("newest-data") : `${time(span.from_s)} – ${time(span.to_s)} (${duration(span.to_s - span.from_s)})`) + kept;
  }
}
