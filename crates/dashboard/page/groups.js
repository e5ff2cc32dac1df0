// A group of plots with a title. A plot is created as soon as it has data.

import { h } from "./dom.js";
import { natural } from "./words.js";

export class PlotGroup {
  #plots = new Map();

  constructor(key, title, text) {
    this.holder = h("div", { class: "plots" });
    this.element = h("section", { class: "group", id: `group-${key}`, hidden: true }, h("h2", {}, title), text ? h("p", { class: "group-text" }, text) : null, this.holder);
  }

  get plots() {
    return [...this.#plots.values()];
  }

  /** Adds a plot in the natural order of the keys, unless it exists. `kind` is that of a further plot. */
  add(name, make, kind = "") {
    const key = kind ? `${name} ${kind}` : name;
    if (this.#plots.has(key)) return;
    const plot = Object.assign(make(), { group: name });
    const after = [...this.#plots.keys()].filter((other) => natural(other, key) > 0).sort(natural)[0];
    this.holder.insertBefore(plot.element, this.#plots.get(after)?.element ?? null);
    this.#plots.set(key, plot);
    this.element.hidden = false;
  }

  /** Shows only the plots with these keys. */
  show(keys) {
    for (const plot of this.#plots.values()) plot.element.hidden = !keys.has(plot.group);
  }

  drop(key) {
    const plot = this.#plots.get(key);
    if (!plot) return;
    plot.close();
    plot.element.remove();
    this.#plots.delete(key);
  }
}
