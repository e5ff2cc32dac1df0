// A group of plots with a title. A plot is created as soon as it has data.

import { h } from "./dom.js";
import { t } from "./language.js";
import { natural } from "./words.js";

export class PlotGroup {
  #plots = new Map();

  /**
   * `names` is the order of the plots. Other plots have the natural order of their names. With
   * `isFolded`, the plots are folded away at first.
   */
  constructor(key, title, text, names = [], isFolded = false) {
    this.names = names;
    this.holder = h("div", { class: "plots" });
    this.element = h("section", { class: "group", id: `group-${key}`, hidden: true }, h("h2", {}, title), text ? h("p", { class: "group-text" }, text) : null, isFolded ? h("details", { class: "routine" }, h("summary", {}, t("show-the-plots")), this.holder) : this.holder);
  }

  get plots() {
    return [...this.#plots.values()];
  }

  /** Adds a plot at its place, unless it exists. `kind` is that of a further plot. */
  add(name, make, kind = "") {
    const key = kind ? `${name} ${kind}` : name;
    if (this.#plots.has(key)) return;
    const plot = Object.assign(make(), { group: name });
    const place = ([key, { group }]) => [this.names.indexOf(group), key];
    const compare = (a, b) => place(a)[0] - place(b)[0] || natural(place(a)[1], place(b)[1]);
    const [after] = [...this.#plots].filter((other) => compare(other, [key, plot]) > 0).sort(compare)[0] ?? [];
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
