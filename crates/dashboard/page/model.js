// The tab of the model: whether it explains the data, and what it learns besides the parameters.

import { h } from "./dom.js";
import { PlotGroup } from "./groups.js";
import { classPlot, consistencyPlot, innovationPlot, noisePlot } from "./plots.js";
import { FITS, setSentence } from "./words.js";

export class ModelTab {
  key = "model";
  hasSpan = true;
  #classes = [];

  constructor(page) {
    this.page = page;
    this.fit = h("p", { class: "fit", hidden: true });
    this.none = h("p", { class: "empty" }, "No data yet.");
    this.groups = {
      classes: new PlotGroup("classes", "Model classes"),
      agreement: new PlotGroup("agreement", "Model and data"),
      innovations: new PlotGroup("innovations", "Innovations", "Observed minus predicted value: minimum and maximum in each interval."),
      noise: new PlotGroup("noise", "Noise levels"),
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
      if (sensor) this.groups.innovations.add(of, () => innovationPlot(sensor, points, span));
      if (kind === "consistency") this.groups.agreement.add(of, () => consistencyPlot(points, span));
      if (kind !== "class" || this.#classes.includes(of)) continue;
      this.#classes.push(of);
      // A new class changes the whole stack.
      this.groups.classes.drop("all");
      this.groups.classes.add("all", () => classPlot([...this.#classes], points, span));
    }
  }

  update({ fit }) {
    this.none.hidden = this.plots.length > 0;
    this.fit.hidden = !fit;
    if (!fit) return;
    this.fit.dataset.level = FITS[fit.verdict].level;
    setSentence(this.fit, `${FITS[fit.verdict].sign} Fit ${fit.verdict}: ${fit.words}.`);
  }
}
