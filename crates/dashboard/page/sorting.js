// Sorts the rows of a table by the column whose title is pressed. A phone shows no titles, but a list.

import { h, setAttribute } from "./dom.js";
import { t } from "./language.js";
import { natural } from "./words.js";

/** The next order of a column. Without one, the rows have their usual order. */
const NEXT = new Map([[null, "ascending"], ["ascending", "descending"], ["descending", null]]);

/** Returns the name of an order in an address. */
const nameOf = (column, order) => `${column + 1}-${order}`;

export class Sorting {
  #column = null;
  #order = null;

  /** `changed()` is called after another column or order is chosen. */
  constructor(titles, hints, changed) {
    this.heads = titles.map((title, column) => {
      const button = h("button", { type: "button", class: "sort", onclick: () => this.#choose(column, NEXT.get(column === this.#column ? this.#order : null), changed) }, title);
      return h("th", { scope: "col", title: hints[title] }, button);
    });
    const options = titles.flatMap((title, column) => ["ascending", "descending"].map((order) => h("option", { value: nameOf(column, order) }, `${title} ${order === "ascending" ? "↑" : "↓"}`)));
    this.list = h("select", { onchange: () => this.#choose(...this.#listed(), changed) }, h("option", { value: "" }, t("usual-order")), options);
    this.field = h("label", { class: "sort-by" }, t("sort-by"), " ", this.list);
  }

  /**
   * Returns the rows in the chosen order. `values(row)` returns a number, a text or null for each column.
   * Rows without a value are last, and rows with the same value keep their order.
   */
  sorted(rows, values) {
    if (this.#order === null) return rows;
    const sign = this.#order === "ascending" ? 1 : -1;
    const compare = (a, b) => (typeof a === "number" ? a - b : natural(a, b));
    const valued = rows.map((row) => ({ row, value: values(row)[this.#column] ?? null }));
    valued.sort(({ value: a }, { value: b }) => (a === null || b === null ? (a === null) - (b === null) : sign * compare(a, b)));
    return valued.map(({ row }) => row);
  }

  /** The chosen order for an address, such as `2-descending`. Empty for the usual order. */
  get text() {
    return this.list.value;
  }

  /** Chooses the order in an address, or the usual order if there is no such one. */
  enter(text) {
    this.list.value = text;
    if (this.list.selectedIndex < 0) this.list.value = "";
    this.#choose(...this.#listed());
  }

  #listed() {
    const [column, order] = this.list.value.split("-");
    return [Number(column) - 1, order ?? null];
  }

  #choose(column, order, changed = () => {}) {
    [this.#column, this.#order] = [column, order];
    this.list.value = order === null ? "" : nameOf(column, order);
    this.heads.forEach((head, index) => setAttribute(head, "aria-sort", index === column ? this.#order : null));
    changed();
  }
}
