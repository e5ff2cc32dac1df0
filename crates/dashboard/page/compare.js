// The tab that compares two time ranges: parameters and natural frequencies, drawn over each other by
// the time since the start of their range, with the difference of their means in words.

import { h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { HOLE_STEPS, Plot, css, look, padded } from "./plot.js";
import { lateNotice, showTimes, timeIn } from "./ranges.js";
import { Scale } from "./span.js";
import { AXES, COLUMNS, comparedMeans, comparedValue, duration, isWithoutDate, setSentence, time, timeOfAlert } from "./words.js";
import { Extent } from "./year.js";

/** Number of points of each series and range. */
const POINTS = 1000;
/** Number of series in one request. The server allows 256. */
const SERIES_PER_REQUEST = 200;
/** Number of quantities that each have a plot. With more, only the chosen one has. */
const MOST_PLOTS = 6;
/** Half-width of the 95 % interval of a Gaussian, in standard deviations. */
const HALF_95 = 1.96;
const DAY_S = 86400;
/** Ranges that a button selects: names and lengths (s) of two ranges, the second up to the newest data. */
const USUAL = [
  [t("last-hour-and-the-hour-before"), 3600],
  [t("last-day-and-the-day-before"), DAY_S],
  [t("last-week-and-the-week-before"), 7 * DAY_S],
];
/** States of an alert that make the ranges before and since its start the ones to compare. */
const ACTIVE = ["raised", "unconfirmed", "acknowledged"];
const NAMES = [t("first-range"), t("second-range")];
const KEYS = ["first", "second"];
const LOOKS = [0, 1].map((index) => ({ ...look(index), band: ["--band-95", "--band-second"][index] }));

/**
 * Returns the mean of the estimates { mean, std } in a range, or null without any.
 *
 * The errors of a parameter within a range are almost the same error, because each estimate builds on
 * the last one. The standard deviation of their mean is therefore that of one estimate. Epochs of
 * modes are estimated independently. Their mean has the larger of two standard deviations: the one
 * that the epochs state, and the one of their scatter.
 */
export function meanOf([, values, stds], areIndependent) {
  const rows = values.map((_, row) => row).filter((row) => values[row] !== null && stds[row] !== null);
  if (rows.length === 0) return null;
  const count = rows.length;
  const sum = (of) => rows.reduce((total, row) => total + of(row), 0);
  const mean = sum((row) => values[row]) / count;
  if (!areIndependent) return { mean, std: sum((row) => stds[row]) / count, count };
  const stated = Math.sqrt(sum((row) => stds[row] ** 2)) / count;
  const scatter = count > 1 ? Math.sqrt(sum((row) => (values[row] - mean) ** 2) / (count - 1) / count) : 0;
  return { mean, std: Math.max(stated, scatter), count };
}

/**
 * Returns the difference of two means with its 95 % interval, or null without both.
 *
 * One in twenty equal quantities is outside its interval. `isByChance` states that the interval excludes 0,
 * but that the difference is not larger than expected of one in `count` quantities (Bonferroni).
 */
export function differenceOf(first, second, count = 1) {
  if (!first || !second) return null;
  const difference = second.mean - first.mean;
  const std = Math.hypot(first.std, second.std);
  const size = Math.abs(difference);
  return { difference, low: difference - HALF_95 * std, high: difference + HALF_95 * std, isByChance: size > HALF_95 * std && size <= quantile(0.05 / count) * std };
}

/**
 * Returns how many standard deviations a Gaussian exceeds on either side with a small probability.
 *
 * Source: Abramowitz & Stegun (1964), equation (26.2.23); error below 4.5e-4.
 */
function quantile(probability) {
  const t = Math.sqrt(-2 * Math.log(probability / 2));
  return t - (2.515517 + t * (0.802853 + t * 0.010328)) / (1 + t * (1.432788 + t * (0.189269 + t * 0.001308)));
}

/** Returns the columns on other times, by linear interpolation. Values in gaps are null. */
function onto(times, columns) {
  const [own] = columns;
  const steps = own.slice(1).map((time, index) => time - own[index]);
  const usual = steps.toSorted((a, b) => a - b)[steps.length >> 1] ?? 0;
  let row = 0;
  const places = times.map((time) => {
    while (row + 1 < own.length && own[row + 1] <= time) row += 1;
    if (own[row] === time) return [row, 0];
    const isInside = own[row] < time && row + 1 < own.length && own[row + 1] - own[row] <= HOLE_STEPS * usual;
    return isInside ? [row, (time - own[row]) / (own[row + 1] - own[row])] : null;
  });
  return columns.slice(1).map((column) => places.map((place) => {
    if (place === null) return null;
    const [at, share] = place;
    if (share === 0) return column[at];
    return column[at] === null || column[at + 1] === null ? null : column[at] + share * (column[at + 1] - column[at]);
  }));
}

/** The points of all quantities in two ranges. */
class TwoRanges {
  #series = new Map();
  /** The two ranges, each { from_s, to_s }. */
  ranges = null;
  /** Time from which data are stored (s since 1970), or null. */
  keptFrom_s = null;
  /** Whether the history has not supplied all data in time. */
  isLate = false;
  extent = new Extent();

  constructor(structure) {
    this.structure = structure;
  }

  /** Returns the columns of both ranges by the time since their start, or null before they have arrived. */
  columns(name) {
    return this.#series.get(name) ?? null;
  }

  csv([name]) {
    const rows = (this.columns(name) ?? []).flatMap((columns, range) => columns[0].map((since, row) => `${range + 1},${since},${columns[1][row] ?? ""},${columns[2][row] ?? ""}`));
    return `data:text/csv,${encodeURIComponent(["range,time_since_start_s,mean,std", ...rows].join("\n"))}`;
  }

  /** Plots fetch nothing, because the tab fetches both ranges at once. */
  async fetch() {
    return this.#series.size > 0;
  }

  /** Fetches both ranges of all series. Returns whether they have arrived, and are still wanted. */
  async load(names) {
    const { ranges } = this;
    const answers = await Promise.all(ranges.map((range) => this.#range(range, names)));
    if (answers.includes(null) || ranges !== this.ranges) return false;
    this.isLate = answers.some(({ isLate }) => isLate);
    // A mean of a part of a range is none of the range.
    this.#series = new Map(this.isLate ? [] : names.map((name) => [name, answers.map(({ found }) => found.get(name))]));
    this.extent.late = new Set(this.isLate ? names : []);
    this.extent.all = [0, Math.max(...ranges.map(({ from_s, to_s }) => to_s - from_s))];
    return true;
  }

  async #range({ from_s, to_s }, names) {
    const found = new Map();
    let isLate = false;
    for (let at = 0; at < names.length; at += SERIES_PER_REQUEST) {
      const query = new URLSearchParams({ series: names.slice(at, at + SERIES_PER_REQUEST).join(","), points: POINTS, from: from_s, to: to_s });
      const response = await fetch(`/api/structures/${encodeURIComponent(this.structure)}/history?${query}`);
      if (!response.ok) return null;
      const answer = await response.json();
      this.keptFrom_s = answer.kept_from_s;
      isLate ||= answer.incomplete;
      for (const { name, data } of answer.series) found.set(name, [data[0].map((time) => time - from_s), ...data.slice(1)]);
    }
    return { found, isLate };
  }
}

export class CompareTab {
  key = "compare";
  hasSpan = false;
  /** Name of the quantity whose plot is shown, if not all are. */
  chosen = null;
  plots = [];
  /** Shared range of the stiffnesses, so that a small difference does not look like a large one. */
  #scale = new Scale();
  /** The ranges that are being loaded, or null. */
  #loading = null;

  constructor(page) {
    this.page = page;
    const { parameters, modes } = page.about;
    this.quantities = [
      ...parameters.map(({ name, stiffness }) => ({ name, series: `parameter/${name}`, unit: "", isStiffness: stiffness, axis: AXES.ratio, areIndependent: false })),
      ...modes.map(({ name }) => ({ name, series: `mode/${name}`, unit: "Hz", axis: t("natural-frequency-hz"), areIndependent: true })),
    ];
    this.points = new TwoRanges(page.name);
    this.points.extent.onchange(() => this.#redraw());
    this.fields = KEYS.map((key) => ({ from: h("input", { id: `${key}-from`, required: true }), to: h("input", { id: `${key}-to`, required: true }) }));
    this.zones = KEYS.map(() => h("span"));
    const range = (key, index) => h("fieldset", {}, h("legend", {}, h("span", { class: `swatch-line is-${key}`, "aria-hidden": "true" }), NAMES[index]), h("label", { for: `${key}-from` }, t("from")), this.fields[index].from, h("label", { for: `${key}-to` }, t("to")), this.fields[index].to, this.zones[index]);
    this.told = h("p", { class: "told", role: "status" });
    this.usual = USUAL.map(([text, length_s]) => h("button", { type: "button", onclick: () => this.#choose(this.#newest(length_s)) }, text));
    this.sinceAlert = h("button", { type: "button", hidden: true, onclick: () => this.#showUsual() }, t("before-and-since-the-alert"));
    this.form = h("form", { class: "two-ranges", onsubmit: (event) => this.#submit(event) }, KEYS.map(range), h("div", { class: "ranges" }, h("button", { type: "submit", class: "main" }, t("compare-the-ranges")), this.sinceAlert, h("button", { type: "button", onclick: () => this.#showHalves() }, t("halves-of-the-shown-span")), this.usual), this.told);
    this.rows = h("tbody");
    const heads = h("tr", {}, COLUMNS.differences.map((text) => h("th", { scope: "col" }, text)));
    this.table = h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": t("differences") }, h("table", { class: "differences" }, h("thead", {}, heads), this.rows));
    this.lengths = h("p", { class: "group-text" });
    this.sentence = h("p", { class: "sentence" });
    this.hidden = h("p", { class: "is-hidden-loss", hidden: true });
    this.late = lateNotice(() => this.#load());
    this.late.hidden = true;
    this.all = h("button", { type: "button", class: "back", hidden: true, onclick: () => this.points.extent.live() }, t("whole-ranges"));
    this.holder = h("div", { class: "plots" });
    const words = t("the-interval-covers-the-errors-of-the");
    this.element = h("section", { class: "group", id: "group-compare" }, h("h2", { class: "sr-only" }, t("comparison")), h("section", { class: "card" }, this.form), h("section", { class: "card" }, this.late, this.hidden, this.sentence, this.lengths, this.table, h("p", { class: "group-text" }, words)), h("div", { class: "tools" }, this.all), this.holder);
    this.#build(this.quantities.length <= MOST_PLOTS ? this.quantities : []);
  }

  /** Draws the plots again when their shared range has changed. */
  draw() {
    if (this.#scale.hasChanged) this.plots.forEach((plot) => plot.dirty());
    this.#scale.hasChanged = false;
  }

  /** What the address states besides the tab. */
  get query() {
    const { ranges } = this.points;
    if (!ranges) return {};
    const text = ({ from_s, to_s }) => `${from_s.toFixed(3)}..${to_s.toFixed(3)}`;
    return { first: text(ranges[0]), second: text(ranges[1]), ...(this.chosen ? { parameter: this.chosen } : {}) };
  }

  update() {
    // The first data determine the ranges of a page that was opened too early.
    if (!this.points.ranges && this.page.span.newest_s !== null) this.#showUsual();
    this.sinceAlert.hidden = this.#aroundAlert() === null;
  }

  restart() {
    if (this.points.ranges) this.#load();
  }

  /** Shows the ranges and the quantity in the address. */
  goto(name, parameters) {
    const ranges = KEYS.map((key) => rangeOf(parameters.get(key)));
    this.chosen = this.quantities.some((quantity) => quantity.name === name) ? name : null;
    if (!ranges.includes(null)) this.#set(ranges);
    else if (this.page.span.newest_s !== null) this.#showUsual();
  }

  /** Shows the ranges before and since an alert. Both halves of the shown span would hide its loss. */
  #showUsual() {
    const ranges = this.#aroundAlert();
    if (ranges === null) return this.#showHalves();
    this.#choose(ranges);
    this.isUnchosen = true;
  }

  /** Returns the active alerts { parameter, since_s, … } of the structure. */
  #alerts() {
    const { alerts, lasting_alerts: lasting } = this.page.standing();
    return [...alerts, ...lasting].filter(({ state, since_ns: since }) => ACTIVE.includes(state) && since != null).map((alert) => ({ ...alert, since_s: alert.since_ns / 1e9 }));
  }

  /**
   * Returns the range since the first alert that nobody has acknowledged, or else since the first one, and the
   * range before it, of the same length where data are kept. Returns null without an alert before the newest data.
   */
  #aroundAlert(from_s = -Infinity) {
    const end = this.page.span.newest_s;
    const all = this.#alerts().filter(({ since_s: since }) => since < end);
    const open = all.filter(({ state, acknowledged_by: who }) => state !== "acknowledged" && !who);
    const start = Math.min(...(open.length > 0 ? open : all).map(({ since_s: since }) => since));
    if (all.length === 0 || start <= from_s) return null;
    return [{ from_s: Math.max(start - (end - start), from_s), to_s: start }, { from_s: start, to_s: end }];
  }

  /** Shows the halves of the shown span, or of the part of it that has data. */
  #showHalves() {
    this.#choose(this.#halves());
    this.isUnchosen = true;
  }

  #halves(from_s = -Infinity) {
    const { min: start, max } = this.page.span.shown;
    const min = Math.max(start, from_s);
    const middle = (min + max) / 2;
    return [{ from_s: min, to_s: middle }, { from_s: middle, to_s: max }];
  }

  #newest(length_s) {
    const end = this.page.span.newest_s;
    return [{ from_s: end - 2 * length_s, to_s: end - length_s }, { from_s: end - length_s, to_s: end }];
  }

  #choose(ranges) {
    this.#set(ranges);
    this.page.changed();
  }

  #set(ranges) {
    this.isUnchosen = false;
    // Equal ranges that are being loaded need not be loaded again.
    if (JSON.stringify(ranges) !== JSON.stringify(this.points.ranges)) this.points.ranges = ranges;
    const isRecord = isWithoutDate(ranges[1].to_s);
    ranges.forEach(({ from_s, to_s }, index) => showTimes(Object.values(this.fields[index]), [from_s, to_s], this.zones[index]));
    this.usual.forEach((button) => (button.hidden = isRecord));
    this.points.extent.live();
    this.#load();
  }

  #submit(event) {
    event.preventDefault();
    const ranges = this.fields.map(({ from, to }) => ({ from_s: timeIn(from), to_s: timeIn(to) }));
    const wrong = ranges.findIndex(({ from_s, to_s }) => !(to_s > from_s));
    if (wrong >= 0) return setText(this.told, t("range-end-after-start", NAMES[wrong]));
    this.#choose(ranges);
  }

  async #load() {
    const { ranges } = this.points;
    if (this.#loading === ranges) return;
    this.#loading = ranges;
    setText(this.told, "");
    // The address may state other ranges at once.
    await null;
    const isThere = ranges === this.points.ranges && this.quantities.length > 0 && (await this.points.load(this.quantities.map(({ series }) => series)).catch(() => false));
    if (this.#loading === ranges) this.#loading = null;
    if (ranges !== this.points.ranges) return;
    if (!isThere) return setText(this.told, this.quantities.length > 0 ? t("cannot-reach-spandrel") : t("this-structure-has-neither-parameters-nor-followed"));
    const { keptFrom_s: kept, isLate } = this.points;
    this.late.hidden = !isLate;
    for (const of of [this.sentence, this.lengths, this.table]) of.hidden = isLate;
    this.hidden.hidden ||= isLate;
    if (isLate) return this.#redraw();
    if (this.isUnchosen && kept !== null && kept > ranges[0].from_s + 1 && kept < ranges[1].to_s - 1) return this.#choose(this.#aroundAlert(kept) ?? this.#halves(kept));
    this.#show();
  }

  #show() {
    const words = ({ from_s, to_s }, index) => t("range-words", NAMES[index], time(from_s), time(to_s), duration(to_s - from_s));
    setSentence(this.lengths, this.points.ranges.map(words).join(" "));
    const means = this.quantities.map((quantity) => this.points.columns(quantity.series).map((columns) => meanOf(columns, quantity.areIndependent)));
    const known = means.filter((both) => !both.includes(null)).length;
    const isMany = this.quantities.length > MOST_PLOTS;
    const results = this.quantities.map((quantity, index) => {
      const [first, second] = means[index];
      return { ...quantity, first, second, change: differenceOf(first, second, known) };
    });
    // Few quantities have the order of the structure file. Of many, the clearest difference is first.
    if (isMany) results.sort((a, b) => clearness(b) - clearness(a));
    if (isMany) {
      const shown = results.find(({ name }) => name === this.chosen) ?? results[0];
      if (this.shown !== shown.name) this.#build([shown]);
      this.shown = shown.name;
    }
    const make = ({ name }) => {
      const cells = COLUMNS.differences.slice(1).map((text, column) => h("td", { class: column < 4 ? "number" : null, "data-head": text }));
      const head = isMany ? h("button", { type: "button", class: "small", onclick: () => this.#pick(name) }, name) : name;
      return { element: h("tr", {}, h("th", { scope: "row" }, head), cells), cells };
    };
    const value = (mean, unit) => (mean ? comparedValue(mean.mean, unit) : "–");
    // What was lost before both ranges is the same in both.
    const earlier = this.#alerts().filter(({ since_s: since }) => this.points.ranges.every(({ from_s }) => from_s >= since));
    const isHidden = ({ name, change, words }) => change && !words.sentence && earlier.some(({ parameter }) => parameter === name);
    const withWords = (one) => ({ ...one, words: comparedMeans(one.change, one.first) });
    const all = results.map(withWords).map((one) => (isHidden(one) ? { ...one, words: { ...one.words, level: "learning", result: t("after-the-alert") } } : one));
    keyed(this.rows, all, ({ series }) => series, make, ({ element, cells }, { name, first, second, unit, words }) => {
      element.dataset.level = words.level;
      if (isMany) element.querySelector("button").setAttribute("aria-pressed", String(name === this.shown));
      [value(first, unit), value(second, unit), words.difference, words.interval, words.result].forEach((text, column) => setText(cells[column], text));
    });
    const alerts = earlier.map((alert) => `${alert.parameter} (${timeOfAlert({ ...alert, state: "raised" }, alert.since_s)})`).join(", ");
    this.hidden.hidden = earlier.length === 0;
    if (earlier.length > 0) setSentence(this.hidden, t("both-ranges-are-after-the-alert", alerts));
    setText(this.sentence, summary(all, earlier.length > 0));
    this.#redraw();
  }

  #pick(name) {
    this.chosen = name;
    this.#show();
    this.page.changed();
  }

  #build(quantities) {
    this.plots.forEach((plot) => plot.close());
    this.#scale = new Scale();
    this.plots = quantities.map((quantity) => comparePlot(quantity, this.points, (range) => (quantity.isStiffness ? this.#scale.of(quantity.name, range) : range)));
    this.holder.replaceChildren(...this.plots.map(({ element }) => element));
  }

  #redraw() {
    const { shown, all } = this.points.extent;
    this.all.hidden = shown.min === all[0] && shown.max === all[1];
    this.plots.forEach((plot) => plot.restart());
  }
}

/** Returns a range in the address, or null without a valid one. */
function rangeOf(text) {
  const [from_s, to_s] = (text ?? "").split("..").map((part) => (part === "" ? NaN : Number(part)));
  return Number.isFinite(from_s) && Number.isFinite(to_s) && to_s > from_s ? { from_s, to_s } : null;
}

/** Maximum number of differences that the sentence names, the clearest first. */
const MOST_NAMED = 3;

/** Returns the differences in one sentence. Without any, a loss from before both ranges is no good news. */
function summary(results, isAfterAlert) {
  const known = results.filter(({ change }) => change);
  if (known.length === 0) return t("no-quantity-has-data-in-both-ranges");
  const clear = known.filter(({ words }) => words.sentence).sort((a, b) => clearness(b) - clearness(a));
  if (clear.length === 0 && known.length < results.length) return t("no-difference-among-known", known.length, results.length);
  if (clear.length === 0 && isAfterAlert) return t("no-difference-besides");
  if (clear.length === 0) return known.some(({ change }) => change.isByChance) ? t("no-difference-beyond-chance", known.length) : t("no-difference-is-shown-the-95-per");
  const named = clear.slice(0, MOST_NAMED).map(({ name, words }) => `${name} ${words.sentence}`);
  const more = clear.length - named.length;
  return `◆ ${named.join("; ")}${more > 0 ? t("and-more", more) : ""}.`;
}

/** Returns how clear a difference is, in half-widths of its interval. */
function clearness({ change }) {
  return change ? Math.abs(change.difference) / (change.high - change.difference || Infinity) : -1;
}

/**
 * Creates the plot of one quantity in both ranges, with the 95 % intervals. `shared(range)` returns the
 * shown range for the range that the quantity needs.
 */
function comparePlot({ name, series, unit, axis, areIndependent }, points, shared) {
  const edge = { stroke: "transparent", width: 0 };
  const line = ({ colour, dash }) => ({ stroke: () => css(colour), width: 2, dash, points: { show: areIndependent, size: 5 } });
  const told = (data, at, column) => (data[column][at] == null ? "–" : comparedValue(data[column][at], unit));
  return new Plot(
    {
      title: name,
      file: `compare-${series.replace("/", "-")}`,
      unit: axis,
      names: [series],
      sync: "compare",
      isSinceStart: true,
      legend: NAMES.map((text, index) => ({ name: text, ...LOOKS[index] })),
      rows: (columns) => {
        const both = columns.get(series);
        const times = [...new Set(both.flatMap(([times]) => times))].sort((a, b) => a - b);
        const aligned = both.map((columns) => onto(times, columns));
        const bands = aligned.flatMap(([means, stds]) => [-HALF_95, HALF_95].map((half) => means.map((mean, row) => (mean === null ? null : mean + half * stds[row]))));
        return [times, ...aligned.map(([means]) => means), ...bands];
      },
      series: () => [...LOOKS.map(line), edge, edge, edge, edge],
      bands: () => LOOKS.map(({ band }, index) => ({ series: [4 + 2 * index, 3 + 2 * index], fill: css(band) })),
      range: (u) => {
        const { min, max } = points.extent.shown;
        const seen = (column) => u.data[column].filter((value, row) => value != null && u.data[0][row] >= min && u.data[0][row] <= max).sort((a, b) => a - b);
        // The wide intervals of the first seconds would flatten the rest.
        const lows = [3, 5].flatMap((column) => seen(column).at(Math.round(0.05 * (seen(column).length - 1))) ?? []);
        const highs = [4, 6].flatMap((column) => seen(column).at(Math.round(0.95 * (seen(column).length - 1))) ?? []);
        return shared(lows.length > 0 ? padded(u, Math.min(...lows), Math.max(...highs)) : null) ?? [0, 1];
      },
      // The ranges can end at different times.
      newest: ([times, first, second]) => times.findLastIndex((_, row) => first[row] != null && second[row] != null),
      readout: (data, at) => t("first-second", told(data, at, 1), told(data, at, 2)),
    },
    points,
    points.extent,
  );
}
