// The tab of the model: whether it explains the data, and what it learns besides the parameters.

import { h, setText } from "./dom.js";
import { PlotGroup } from "./groups.js";
import { t } from "./language.js";
import { classPlot, consistencyPlot, innovationPlot, noisePlot } from "./plots.js";
import { Scale } from "./span.js";
import { BLIND, FITS, SERVICES, setSentence, wordOf } from "./words.js";

/** Number of plots of a group above which they are folded away. */
const MOST_FULL = 6;

export class ModelTab {
  key = "model";
  hasSpan = true;
  #classes = [];
  /** Shared ranges of the innovations of the sensors with one unit. */
  #scales = new Map();

  constructor(page) {
    this.page = page;
    [this.verdict, this.reasons] = [h("span"), h("span", { lang: SERVICES })];
    this.fit = h("p", { class: "fit", hidden: true }, this.verdict, this.reasons);
    this.none = h("p", { class: "empty" }, t("no-data-yet"));
    const { drawing, noise } = page.about;
    this.groups = {
      classes: new PlotGroup("classes", t("model-classes")),
      agreement: new PlotGroup("agreement", t("model-and-data")),
      innovations: new PlotGroup("innovations", t("innovations"), t("observed-minus-predicted-value-minimum-and-maximum"), [], drawing.sensors.length > MOST_FULL),
      noise: new PlotGroup("noise", t("noise-levels"), "", [], noise.length > MOST_FULL),
    };
    this.element = h("div", {}, this.fit, this.none, Object.values(this.groups).map(({ element }) => element));
  }

  get plots() {
    return Object.values(this.groups).flatMap((group) => group.plots);
  }

  /** Creates plots for new series. */
  discover({ noise, series }) {
    const { about, points, span } = this.page;
    for (const level of about.noise) {
      if (noise[level.name]) this.groups.noise.add(level.name, () => noisePlot(level, points, span));
    }
    for (const name of series) {
      const [kind, of] = [name.slice(0, name.indexOf("/")), name.slice(name.indexOf("/") + 1)];
      const sensor = kind === "innovation" ? about.drawing.sensors.find((sensor) => sensor.channel === of) : null;
      if (sensor) this.groups.innovations.add(of, () => innovationPlot(sensor, points, span, this.#shared(sensor)));
      if (kind === "consistency") this.groups.agreement.add(of, () => consistencyPlot(points, span));
      if (kind !== "class" || this.#classes.includes(of)) continue;
      this.#classes.push(of);
      // A new class changes the whole stack.
      this.groups.classes.drop("all");
      this.groups.classes.add("all", () => classPlot([...this.#classes], points, span));
    }
  }

  /** Draws the innovations again when their shared range has changed. */
  draw() {
    for (const scale of this.#scales.values()) {
      if (scale.hasChanged) this.groups.innovations.plots.forEach((plot) => plot.dirty());
      scale.hasChanged = false;
    }
  }

  #shared({ channel, unit }) {
    if (!this.#scales.has(unit)) this.#scales.set(unit, new Scale());
    return (range) => this.#scales.get(unit).of(channel, range);
  }

  update({ fit }) {
    this.none.hidden = this.plots.length > 0;
    this.fit.hidden = !fit;
    if (!fit) return;
    const { sign, level } = fit.past ? { sign: BLIND.sign, level: "learning" } : FITS[fit.verdict];
    this.fit.dataset.level = level;
    setText(this.verdict, t("fit-verdict", sign, fit.past ? t("last-known", wordOf(fit.verdict)) : wordOf(fit.verdict)));
    setSentence(this.reasons, `${fit.words}.`);
  }
}
