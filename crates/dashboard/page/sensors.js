// The tab of the sensors: their state, and what they and the instruments beside them show.

import { h, keyed, setText } from "./dom.js";
import { PlotGroup } from "./groups.js";
import { t } from "./language.js";
import { NodeTable } from "./nodes.js";
import { conditionPlot, nodePlot, outlierPlot, waveformPlot } from "./plots.js";
import { searchField } from "./search.js";
import { SensorSmalls } from "./sensorsmalls.js";
import { Sorting } from "./sorting.js";
import { Scale } from "./span.js";
import { Spectra, spectrumPlot } from "./spectra.js";
import { spectrogramPlot } from "./spectrogram.js";
import { Recording, WaveformPoints } from "./waveforms.js";
import { COLUMNS, HEALTH, HINTS, clockWords, compared, conditionWords, levelWords, number, percent, time, unit, wordOf } from "./words.js";

/** Number of sensors that each have full plots. With more, the tables and the plots of outliers are folded away. */
const MOST_FULL = 6;

/** States of a sensor without samples, whose clock says nothing. */
const UNHEARD = ["gone", "silent", "ended", "no-sample", "unknown"];

/** The states of a sensor, in the order of a sorted table. */
const STATES = Object.keys(HEALTH);

export class SensorsTab {
  key = "sensors";
  hasSpan = true;
  hasWaveforms = true;
  /** Name of the sensor whose details are shown. */
  chosen = null;
  /** Whether the page shall scroll to the waveforms as soon as they are there. */
  #isSought = false;
  /** Shared ranges of the waveforms, and of the spectra, of the sensors with one unit. */
  #scales = new Map();

  constructor(page) {
    this.page = page;
    const { about } = page;
    this.sensors = new Map(about.drawing.sensors.map((sensor) => [sensor.channel, sensor]));
    this.rows = h("tbody");
    const changed = () => {
      this.update(page.standing());
      page.changed();
    };
    this.sorting = new Sorting(COLUMNS.sensors, HINTS, changed);
    this.levelSorting = new Sorting(COLUMNS.levels, HINTS, changed);
    const heads = h("tr", {}, this.sorting.heads);
    const scroll = { class: "scroll tall", tabindex: "0", role: "region", "aria-label": t("sensors") };
    this.search = searchField(this.sensors.size, t("find-a-sensor"), changed);
    // The samples of sensors with their own filters stay at their nodes.
    const stay = about.has_waveforms ? t("samples-stay-waveforms-come") : t("samples-stay-at-the-nodes");
    const rate = t("nominal-rate", number(about.sampling_rate_hz));
    this.nodes = new NodeTable();
    this.conditionList = h("ul", { class: "sensor-list", id: "conditions" });
    this.levels = h("tbody");
    this.own = h("input", { type: "checkbox", onchange: () => this.#rescale() });
    this.spectra = new Spectra(page.name);
    this.spectra.band.onchange(() => [...this.groups.spectra.plots, ...this.detail.values()].forEach((plot) => plot.dirty()));
    this.recording = new Recording(page);
    this.waveforms = new WaveformPoints(page.name, page.span, this.recording);
    const isMany = this.sensors.size > MOST_FULL && about.has_waveforms;
    this.smalls = isMany ? new SensorSmalls(page, this.sensors, this.recording, (channel) => this.#open(channel)) : null;
    this.detail = new Map();
    this.detailPlots = h("div", { class: "plots" });
    this.details = h("div", { class: "detail sensor-detail", hidden: true }, this.detailPlots, h("button", { type: "button", class: "small", onclick: () => this.#open(this.chosen) }, t("close-details")));
    this.why = h("p", { class: "told", role: "status", hidden: true });
    const channels = [...this.sensors.keys()];
    this.groups = {
      waveforms: new PlotGroup("waveforms", t("waveforms"), t("the-samples-between-the-minimum-and-the") + (isMany ? ` ${t("select-a-sensor")}` : ""), channels),
      spectra: new PlotGroup("spectra", t("spectra"), t("power-spectral-density-of-about-the-last"), channels),
      nodes: new PlotGroup("nodes", t("distributed-nodes"), t("a-node-far-beyond-the-red-dashed")),
      outliers: new PlotGroup("outliers", t("outliers"), "", [], this.sensors.size > MOST_FULL),
      conditions: new PlotGroup("conditions", t("conditions"), t("slow-quantities-that-instruments-measure-beside-the")),
    };
    this.groups.nodes.holder.before(this.nodes.element);
    this.groups.conditions.holder.before(this.conditionList);
    for (const condition of about.conditions) this.groups.conditions.add(condition.name, () => conditionPlot(condition, page.points, page.span));
    const levelHeads = h("tr", {}, this.levelSorting.heads);
    const levelScroll = { class: "scroll tall", tabindex: "0", role: "region", "aria-label": t("samples-of-the-last-minute") };
    const scale = h("label", { class: "check" }, this.own, t("each-plot-with-its-own-scale"));
    const levelText = t("rms-and-peak-are-differences-from-the");
    if (isMany) {
      this.groups.waveforms.holder.replaceWith(h("div", { class: "tools" }, scale, this.search.element), this.why, this.details, this.smalls.element);
      this.groups.waveforms.element.hidden = false;
    } else {
      this.groups.waveforms.holder.before(scale, this.why);
    }
    const folded = (text, ...content) => (isMany ? h("details", { class: "routine" }, h("summary", {}, text), content) : content);
    this.samples = h("section", { class: "card", id: "levels", hidden: true }, h("h2", {}, t("samples-of-the-last-minute")), folded(t("show-the-table"), h("p", { class: "group-text" }, levelText), this.levelSorting.field, h("div", levelScroll, h("table", { class: "sensors levels" }, h("thead", {}, levelHeads), this.levels))));
    const table = h("section", { class: "card", id: "sensors" }, h("div", { class: "card-head" }, h("h2", {}, t("sensors")), isMany ? null : this.search.element), h("p", { class: "group-text" }, rate, about.distributed ? ` ${stay}` : ""), folded(t("show-the-table"), this.sorting.field, h("div", scroll, h("table", { class: "sensors" }, h("thead", {}, heads), this.rows))));
    this.element = h("div", {}, isMany ? this.groups.waveforms.element : null, table, this.samples, Object.values(this.groups).map(({ element }) => element).filter((element) => !isMany || element !== this.groups.waveforms.element));
  }

  get plots() {
    return [...this.detail.values(), ...Object.values(this.groups).flatMap((group) => group.plots)];
  }

  /** Names of all series of the tab, for the export. The spectra have a file each. */
  get names() {
    const { spectra, ...series } = this.groups;
    return [...new Set([...(this.smalls?.names ?? []), ...Object.values(series).flatMap(({ plots }) => plots.flatMap(({ plot }) => plot.names))])];
  }

  /** What only this tab states in the address. */
  get query() {
    return { sensor: this.chosen, find: this.search.text(), sort: this.sorting.text, "sort-levels": this.levelSorting.text };
  }

  /** Shows the sensor, the waveforms of the range, the search and the order in the address. */
  goto(_, parameters) {
    const text = (name) => parameters.get(name) ?? "";
    this.search.enter(text("find"));
    this.sorting.enter(text("sort"));
    this.levelSorting.enter(text("sort-levels"));
    if (this.page.standing()) this.update(this.page.standing());
    this.#isSought = parameters.has("from");
    const channel = parameters.get("sensor");
    this.#choose(this.smalls && this.sensors.has(channel) ? channel : null);
  }

  /** Creates plots for new series. */
  discover({ outliers, nodes, sensors }) {
    const { points, span } = this.page;
    for (const { channel, level } of sensors) {
      const sensor = this.sensors.get(channel);
      if (level && sensor && !this.smalls) this.groups.waveforms.add(channel, () => waveformPlot(sensor, this.waveforms, span, this.#shared("waveform", sensor)));
    }
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
    // Trouble first, otherwise the order of the structure file.
    const isSound = ({ health }) => Number(HEALTH[health].level !== "warning");
    const found = sensors.filter(({ channel, node }) => this.search.finds(`${channel} ${node}`)).sort((a, b) => isSound(a) - isSound(b));
    const make = () => {
      const cells = COLUMNS.sensors.map((head, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": head })));
      return { element: h("tr", {}, cells), cells };
    };
    const values = (sensor) => this.#values(sensor, outliers[sensor.channel]);
    keyed(this.rows, this.sorting.sorted(found, values), (sensor) => sensor.channel, make, (part, sensor) => this.#fill(part, sensor, outliers[sensor.channel], isReported));
    this.#hideEmptyColumns();
    this.#showLevels(found);
    this.smalls?.update(found, isReported);
    const names = new Set(found.map(({ channel }) => channel));
    for (const group of [this.groups.waveforms, this.groups.spectra]) group.show(names);
    this.own.checked = !this.page.scale.isCommon;
  }

  take(series) {
    const changed = new Set(this.waveforms.take(series));
    this.smalls?.take(series);
    for (const plot of [...this.groups.waveforms.plots, ...this.detail.values()]) {
      if (plot.plot.names.some((name) => changed.has(name))) plot.dirty();
    }
  }

  /** Fetches the small waveforms and the spectra again, as after a lost connection or for another span. */
  restart() {
    this.recording.restart();
    this.smalls?.restart();
    this.#fetchSpectra();
  }

  /** Fetches the newest spectra, and draws again what shares a scale that has changed. */
  draw(options) {
    const { element } = this.groups.waveforms;
    // The tables above the waveforms would otherwise hide them, and a plot outside the window is not drawn.
    if (this.#isSought && !element.hidden) {
      this.#isSought = false;
      element.scrollIntoView();
    }
    this.#fetchSpectra();
    this.smalls?.draw(options);
    setText(this.why, this.recording.why);
    this.why.hidden = !this.recording.why;
    for (const [name, scale] of this.#scales) {
      if (!scale.hasChanged) continue;
      scale.hasChanged = false;
      this.groups[name.startsWith("waveform") ? "waveforms" : "spectra"].plots.forEach((plot) => plot.dirty());
    }
  }

  async #fetchSpectra() {
    const asked = this.spectra.fetch();
    if (asked === this.asked) return;
    this.asked = asked;
    if (!(await asked)) return;
    const modes = () => (this.page.standing().modes ?? []).map(({ mode, estimate, declared_hz: declared }) => ({ name: mode, frequency: estimate?.frequency_hz ?? declared }));
    this.modes = modes;
    this.#fillDetail();
    for (const channel of this.spectra.channels) {
      const sensor = this.sensors.get(channel);
      if (!sensor || this.smalls) continue;
      this.groups.spectra.add(channel, () => spectrumPlot(sensor, this.spectra, this.#shared("spectrum", sensor), modes));
      this.groups.spectra.add(channel, () => spectrogramPlot(sensor, this.spectra.history, this.page.span, modes), "over time");
    }
    for (const plot of [...this.groups.spectra.plots, ...this.detail.values()]) plot.dirty();
  }

  /** Opens the details of a sensor, or closes them. */
  #open(channel) {
    this.#choose(channel === this.chosen ? null : channel);
    // The button that closes the details is gone with them.
    if (this.chosen === null) this.smalls.focus(channel);
    this.page.changed();
    this.detail.get("waveform")?.element.scrollIntoView({ block: "center" });
  }

  #choose(channel) {
    if (channel === this.chosen) return;
    for (const plot of this.detail.values()) plot.close();
    this.detail.clear();
    this.detailPlots.replaceChildren();
    this.chosen = channel;
    this.details.hidden = channel === null;
    this.smalls?.mark(channel);
    this.#fillDetail();
  }

  /** Creates the large plots of the chosen sensor: its waveform, and the spectra as soon as they are there. */
  #fillDetail() {
    const sensor = this.sensors.get(this.chosen);
    if (!sensor) return;
    const add = (key, make) => {
      if (this.detail.has(key)) return;
      const plot = make();
      // Elsewhere, the title of a group says what its plots show.
      if (key === "spectrum") setText(plot.head.firstChild, t("spectrum-of", sensor.channel));
      this.detail.set(key, plot);
      this.detailPlots.append(plot.element);
    };
    const own = (range) => range;
    add("waveform", () => waveformPlot(sensor, this.waveforms, this.page.span, own));
    if (!this.modes || !this.spectra.columns(sensor.channel)) return;
    add("spectrum", () => spectrumPlot(sensor, this.spectra, own, this.modes));
    add("spectrogram", () => spectrogramPlot(sensor, this.spectra.history, this.page.span, this.modes));
  }

  /** Returns how a plot of a sensor shares its range with the sensors of the same unit. */
  #shared(kind, sensor) {
    const key = `${kind} ${sensor.unit}`;
    if (!this.#scales.has(key)) this.#scales.set(key, new Scale());
    return (range) => (this.page.scale.isCommon ? this.#scales.get(key).of(sensor.channel, range) : range);
  }

  #rescale() {
    this.page.scale.isCommon = !this.own.checked;
    this.page.scale.hasChanged = true;
    this.page.changed();
  }

  #showLevels(sensors) {
    this.samples.hidden = !sensors.some(({ level }) => level) && this.groups.waveforms.plots.length === 0;
    const make = () => {
      const cells = COLUMNS.levels.map((head, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": head, class: column > 1 && column < COLUMNS.levels.length - 1 ? "number" : null })));
      return { element: h("tr", {}, cells), cells };
    };
    const values = ({ channel, health, level }) => [channel, STATES.indexOf(health), level?.rate_hz, level?.mean, level?.rms, level?.peak, level?.last];
    keyed(this.levels, this.levelSorting.sorted(sensors, values), (sensor) => sensor.channel, make, ({ element, cells }, { channel, health, level }) => {
      const { sign, word, level: attention } = HEALTH[health];
      element.dataset.level = attention;
      const texts = [channel, `${sign} ${word}`, ...levelWords(level, this.sensors.get(channel)?.unit ?? "")];
      texts.forEach((text, column) => {
        setText(cells[column], text);
        cells[column].classList.toggle("is-none", text === "–");
      });
    });
  }

  /** Returns the values of a row by which the table is sorted. */
  #values({ channel, node, health, last_used_s: last, compared: of, clock }, outlier) {
    const about = this.sensors.get(channel);
    return [channel, about && wordOf(about.quantity), node, STATES.indexOf(health), last, of?.gain, of?.probability, clock ? clock.offset_s : 0, clock?.difference_s ?? 0, outlier?.recent_share];
  }

  #fill({ element, cells }, sensor, outlier, isReported) {
    const about = this.sensors.get(sensor.channel);
    const health = HEALTH[sensor.health];
    const { relation, fault } = compared(sensor.compared);
    const { offset, clock } = clockWords(sensor.clock, isReported && !UNHEARD.includes(sensor.health));
    const isExcitation = this.page.about.is_filtered && about?.excitation && health.level !== "warning" && sensor.health !== "unknown";
    const lastUsed = sensor.last_used_s == null ? (isExcitation ? t("as-excitation") : "–") : time(sensor.last_used_s);
    element.dataset.level = health.level;
    element.dataset.channel = sensor.channel;
    const texts = [sensor.channel, about ? `${wordOf(about.quantity)}, ${unit(about.unit)}` : "–", sensor.node, `${health.sign} ${health.word}`, lastUsed, relation, fault, offset, clock, outlier ? percent(outlier.recent_share) : "–"];
    texts.forEach((text, column) => {
      setText(cells[column], text);
      cells[column].classList.toggle("is-none", text === "–");
    });
  }

  #hideEmptyColumns() {
    const rows = [...this.rows.children];
    this.sorting.heads.forEach((head, column) => {
      const cells = rows.map((row) => row.children[column]);
      const isEmpty = rows.length > 0 && cells.every(({ textContent }) => textContent === "–");
      for (const cell of [head, ...cells]) cell.hidden = isEmpty;
    });
  }

  #nodeNames() {
    return [...new Set(this.page.about.drawing.sensors.map(({ node }) => node))];
  }
}
