// The tab of the parameters: a plot of each, or small plots of many with the details of one.

import { h } from "./dom.js";
import { t } from "./language.js";
import { parameterPlot } from "./plots.js";
import { searchField } from "./search.js";
import { SmallPlots } from "./smalls.js";

/** Number of parameters that each have a full plot. */
const MOST_FULL = 6;

export class ParametersTab {
  key = "parameters";
  hasSpan = true;
  /** Name of the parameter whose details are shown. */
  chosen = null;
  #full = [];

  constructor(page) {
    this.page = page;
    const { parameters } = page.about;
    this.own = h("input", { type: "checkbox", onchange: () => this.#rescale() });
    const scale = h("label", { class: "check" }, this.own, t("each-plot-with-its-own-scale"));
    const isMany = parameters.length > MOST_FULL;
    // A finger cannot select a span by dragging, because it scrolls the page.
    const drag = matchMedia("(any-pointer: fine)").matches ? ` ${t("drag-across-a-plot")}` : "";
    const words = isMany ? t("line-estimate-band-95-per-cent-interval") : t("line-estimate-bands-50-95-and-99") + drag;
    const text = h("p", { class: "group-text" }, t("ratio-to-the-design-1-is-as", words));
    this.search = searchField(parameters.length, t("find-a-part"), () => this.#found());
    this.smalls = isMany ? new SmallPlots(page, (name) => this.#open(name)) : null;
    this.detail = h("div", { class: "detail", hidden: true });
    if (isMany) this.smalls.above = this.detail;
    if (!isMany) this.#full = parameters.map((parameter) => this.#plot(parameter));
    const all = isMany ? this.smalls.element : h("div", { class: "plots" }, this.#full.map(({ element }) => element));
    this.element = h("section", { class: "group", id: "group-parameters" }, h("h2", { class: "sr-only" }, t("parameters")), h("div", { class: "tools" }, text, scale, this.search.element), this.detail, all);
  }

  get plots() {
    return this.#full;
  }

  /** Names of all series of the tab, for the export. */
  get names() {
    return this.page.about.parameters.map(({ name }) => `parameter/${name}`);
  }

  update(standing) {
    this.own.checked = !this.page.scale.isCommon;
    this.smalls?.update(standing);
  }

  take(series) {
    this.smalls?.take(series);
  }

  restart() {
    this.smalls?.restart();
  }

  draw(options) {
    this.smalls?.draw(options);
  }

  /** What only this tab states in the address. */
  get query() {
    return { find: this.search.text() };
  }

  /** Shows the parameter in the address, and searches for the text in it. */
  goto(name, parameters) {
    this.search.enter(parameters.get("find") ?? "");
    this.#filter();
    this.#show(name);
  }

  #filter() {
    this.smalls?.filter((name) => this.search.finds(name));
  }

  #found() {
    this.#filter();
    this.page.changed();
  }

  #show(name) {
    const parameter = this.page.about.parameters.find((parameter) => parameter.name === name);
    this.element.querySelectorAll(".plot.is-chosen").forEach((chosen) => chosen.classList.remove("is-chosen"));
    if (!parameter) return this.#close();
    this.chosen = name;
    if (this.smalls) this.#showDetail(parameter);
    const plot = document.getElementById(`plot-parameter-${name}`);
    plot?.classList.add("is-chosen");
    plot?.scrollIntoView({ block: "center" });
  }

  #open(name) {
    if (name === this.chosen) this.#close();
    else this.#show(name);
    // The button that closes the details is gone with them.
    if (this.chosen === null) this.smalls.focus(name);
    this.page.changed();
  }

  #close() {
    this.chosen = null;
    this.smalls?.mark(null);
    if (!this.smalls) return;
    this.#full.forEach((plot) => plot.close());
    this.#full = [];
    this.detail.hidden = true;
    this.detail.replaceChildren();
  }

  #showDetail(parameter) {
    this.#close();
    this.chosen = parameter.name;
    this.#full = [this.#plot(parameter)];
    this.detail.hidden = false;
    this.detail.replaceChildren(this.#full[0].element, h("button", { type: "button", class: "small", onclick: () => this.#open(parameter.name) }, t("close-details")));
    this.smalls.mark(parameter.name);
  }

  #plot(parameter) {
    const { standing, points, span, scale } = this.page;
    return parameterPlot(parameter, standing, points, span, this.smalls ? null : scale);
  }

  #rescale() {
    this.page.scale.isCommon = !this.own.checked;
    this.page.scale.hasChanged = true;
    this.page.changed();
  }
}
