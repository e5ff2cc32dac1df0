// The tab of the sensors: their state, and what they and the instruments beside them show.

import { h, keyed, setText } from "./dom.js";
import { PlotGroup } from "./groups.js";
import { NodeTable } from "./nodes.js";
import { conditionPlot, nodePlot, outlierPlot } from "./plots.js";
import { searchField } from "./search.js";
import { COLUMNS, HEALTH, clockWords, compared, conditionWords, number, percent, time, unit } from "./words.js";

export class SensorsTab {
  key = "sensors";
  hasSpan = true;

  constructor(page) {
    this.page = page;
    const { about } = page;
    this.sensors = new Map(about.drawing.sensors.map((sensor) => [sensor.channel, sensor]));
    this.rows = h("tbody");
    const heads = h("tr", {}, COLUMNS.sensors.map((text) => h("th", { scope: "col" }, text)));
    const scroll = { class: "scroll tall", tabindex: "0", role: "region", "aria-label": "Sensors" };
    this.search = searchField(this.sensors.size, "Find a sensor", () => this.update(page.standing()));
    const rate = `All channels have ${number(about.sampling_rate_hz)} samples per second.`;
    this.nodes = new NodeTable();
    this.conditionList = h("ul", { class: "sensor-list", id: "conditions" });
    this.groups = {
      nodes: new PlotGroup("nodes", "Distributed nodes", "A node far beyond the red dashed limit disagrees with the others."),
      outliers: new PlotGroup("outliers", "Outliers"),
      conditions: new PlotGroup("conditions", "Conditions", "Slow quantities that instruments measure beside the motion. Each value is a point."),
    };
    this.groups.nodes.holder.before(this.nodes.element);
    this.groups.conditions.holder.before(this.conditionList);
    for (const condition of about.conditions) this.groups.conditions.add(condition.name, () => conditionPlot(condition, page.points, page.span));
    this.element = h(
      "div",
      {},
      h("section", { class: "card", id: "sensors" }, h("div", { class: "card-head" }, h("h2", {}, "Sensors"), this.search.element), h("p", { class: "group-text" }, rate), h("div", scroll, h("table", { class: "sensors" }, h("thead", {}, heads), this.rows))),
      Object.values(this.groups).map(({ element }) => element),
    );
  }

  get plots() {
    return Object.values(this.groups).flatMap((group) => group.plots);
  }

  /** Creates plots for new series. */
  discover({ outliers, nodes }) {
    const { points, span } = this.page;
    for (const channel of Object.keys(outliers)) this.groups.outliers.add(channel, () => outlierPlot(channel, points, span));
    if (Object.keys(nodes).length === 0) return;
    this.groups.nodes.add("all", () => nodePlot(this.#nodeNames(), points, span));
  }

  update({ sensors, outliers, nodes, services, conditions }) {
    keyed(this.conditionList, conditions, (condition) => condition.name, () => ({ element: h("li") }), (part, condition) => {
      const { level, text } = conditionWords(condition);
      part.element.dataset.level = level;
      setText(part.element, text);
    });
    if (Object.keys(nodes).length > 0) this.nodes.update(this.#nodeNames(), nodes);
    const isReported = services.some(({ service, status }) => service === "ingest" && status);
    const found = sensors.filter(({ channel, node }) => this.search.finds(`${channel} ${node}`));
    const make = () => {
      const cells = COLUMNS.sensors.map((head, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": head })));
      return { element: h("tr", {}, cells), cells };
    };
    keyed(this.rows, found, (sensor) => sensor.channel, make, (part, sensor) => this.#fill(part, sensor, outliers[sensor.channel], isReported));
  }

  #fill({ element, cells }, sensor, outlier, isReported) {
    const about = this.sensors.get(sensor.channel);
    const health = HEALTH[sensor.health];
    const { relation, fault } = compared(sensor.compared);
    const { offset, clock } = clockWords(sensor.clock, isReported);
    element.dataset.level = health.level;
    element.dataset.channel = sensor.channel;
    const texts = [sensor.channel, about ? `${about.quantity.replaceAll("-", " ")}, ${unit(about.unit)}` : "–", sensor.node, `${health.sign} ${health.word}`, sensor.last_used_s == null ? "–" : time(sensor.last_used_s), relation, fault, offset, clock, outlier ? percent(outlier.recent_share) : "–"];
    texts.forEach((text, column) => {
      setText(cells[column], text);
      cells[column].classList.toggle("is-none", text === "–");
    });
  }

  #nodeNames() {
    return [...new Set(this.page.about.drawing.sensors.map(({ node }) => node))];
  }
}
