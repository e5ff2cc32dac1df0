// The time span that all plots of a page share, and the points within it.

import { t } from "./language.js";

/** Number of points to request per series, about the number of columns of a plot. */
const POINTS = 1000;
/** Number of points above which a series is refetched, combined by the server. */
const MOST_POINTS = 3000;
/** Length of a day (s). */
export const DAY_S = 86400;
/** Selectable lengths (s). */
export const LENGTHS = [
  [60, t("1-min")],
  [600, t("10-min")],
  [3600, "1 h"],
  [DAY_S, t("1-day")],
  [30 * DAY_S, t("1-month")],
  [365 * DAY_S, t("1-year")],
  [10 * 365 * DAY_S, t("10-years")],
];

/** The visible time span: the newest data of a given length, or a fixed range. */
export class Span {
  #fixed = null;
  #listeners = [];
  usual_s = 600;
  length_s = 600;
  /** Time of the newest point of any series (s since 1970). */
  newest_s = null;
  /** Time from which all requested data is available (s since 1970). */
  keptFrom_s = null;
  /** Names of the series of which the history has not supplied earlier data in time. */
  late = new Set();

  get isLive() {
    return this.#fixed === null;
  }

  get from_s() {
    return this.#fixed ? this.#fixed[0] : (this.newest_s ?? 0) - this.length_s;
  }

  get to_s() {
    return this.#fixed ? this.#fixed[1] : (this.newest_s ?? 0);
  }

  /**
   * Range that the plots show. A live span starts no earlier than the available data, so that
   * little data also fills the plot.
   */
  get shown() {
    const min = this.isLive && this.lacks ? Math.min(this.keptFrom_s, this.to_s - 1) : this.from_s;
    return { min, max: Math.max(this.to_s, min + 1) };
  }

  /** Whether the span starts before the available data. */
  get lacks() {
    return this.keptFrom_s !== null && this.newest_s !== null && this.from_s < this.keptFrom_s - 1;
  }

  /** Follows the newest data. */
  live(length_s) {
    this.length_s = length_s;
    this.#set(null);
  }

  /** Fixes the span to a range. */
  fix(from_s, to_s) {
    this.#set([from_s, to_s]);
  }

  /** Loads all data of the span again. */
  again() {
    this.#listeners.forEach((listener) => listener());
  }

  onchange(listener) {
    this.#listeners.push(listener);
  }

  #set(fixed) {
    this.#fixed = fixed;
    this.again();
  }
}

/** The range of the y axis that several plots share. */
export class Scale {
  #ranges = new Map();
  /** Whether the plots share one range. Otherwise each has its own. */
  isCommon = true;
  /** Whether the shared range has changed since the plots were drawn. */
  hasChanged = false;

  /** Records the range that a plot needs (null without data), and returns the range that it shows. */
  of(name, own) {
    if (!this.isCommon) return own;
    const before = this.shared;
    if (own !== null) this.#ranges.set(name, own);
    const now = this.shared;
    this.hasChanged ||= before === null || before[0] !== now[0] || before[1] !== now[1];
    return now;
  }

  get shared() {
    const ranges = [...this.#ranges.values()];
    return ranges.length > 0 ? [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))] : null;
  }
}

/** The points of one structure, as far as the visible plots need them. */
export class Points {
  #series = new Map();
  #hasEstimates = false;

  /**
   * With `isThin`, at most `count` points are kept, also of live data, as for waveforms. With
   * `isEnvelope`, a kept point has the extremes of those left out. Otherwise it is the last one.
   */
  constructor(structure, span, { count = POINTS, isThin = false, isEnvelope = false } = {}) {
    Object.assign(this, { structure, span, count, isThin, isEnvelope });
  }

  /** Returns the columns of a series, the time first, or nothing before they have arrived. */
  columns(name) {
    return this.#series.get(name)?.columns ?? null;
  }

  /** Returns the address of the visible data of some series as CSV. */
  csv(names) {
    return this.#address(names, 20000) + "&format=csv";
  }

  /** Refetches the span. Returns whether data has arrived. */
  async fetch(names) {
    for (const name of names) this.#entry(name).asked = true;
    // The page itself reads the samples of a range of waveforms, once for all of its plots.
    const response = await fetch(this.#address(names, this.count) + (this.isEnvelope ? "&recorded=false" : ""));
    if (!response.ok) {
      for (const name of names) this.#entry(name).asked = false;
      return false;
    }
    const answer = await response.json();
    for (const name of names) this.span.late[answer.incomplete ? "add" : "delete"](name);
    if (answer.kept_from_s !== null && !answer.incomplete) this.span.keptFrom_s = Math.min(answer.kept_from_s, this.span.keptFrom_s ?? Infinity);
    for (const { name, generation, data } of answer.series) {
      const entry = this.#entry(name);
      const last = data[0].at(-1) ?? -Infinity;
      const late = entry.generation === generation && entry.columns ? after(entry.columns, last) : null;
      entry.columns = this.span.isLive && late ? joined(data, late) : data;
      entry.generation = generation;
      this.#see(name, entry);
    }
    return true;
  }

  /** Adds received points and returns the names of the changed series. */
  take(series) {
    const changed = [];
    const { shown } = this.span;
    for (const [name, { generation, data }] of Object.entries(series)) {
      const entry = this.#series.get(name);
      const newest = data[0].at(-1);
      // A new run of measurement may start before the points already shown.
      if (entry && entry.generation !== null && entry.generation !== generation && !isSlow(name)) [this.span.newest_s, this.span.keptFrom_s] = [newest, null];
      else this.#advance(name, newest);
      if (!entry?.columns || !this.span.isLive) continue;
      const last = entry.generation === generation ? (entry.columns[0].at(-1) ?? -Infinity) : -Infinity;
      if (entry.generation !== generation) entry.pending = null;
      if (this.isThin) entry.pending = this.isEnvelope ? extremes(joined(entry.pending ?? data.map(() => []), data)) : data.map((column) => column.slice(-1));
      if (this.isThin && newest - last < (shown.max - shown.min) / this.count) continue;
      const more = this.isThin ? entry.pending : data;
      entry.pending = null;
      entry.columns = entry.generation === generation ? joined(entry.columns, after(more, last)) : more;
      entry.generation = generation;
      this.#trim(name, entry);
      changed.push(name);
    }
    return changed;
  }

  /** Drops all series, because no plot shows them any more. */
  clear() {
    this.#series.clear();
    this.span.late.clear();
  }

  #entry(name) {
    if (!this.#series.has(name)) this.#series.set(name, { columns: null, generation: null, asked: false });
    return this.#series.get(name);
  }

  #see(name, entry) {
    const newest = entry.columns[0].at(-1);
    if (newest !== undefined && this.span.isLive) this.#advance(name, newest);
  }

  /**
   * Moves the newest time. Conditions and modes move it only before the first estimate, because
   * their times differ from those of a replayed record, or are those of an epoch that is over.
   */
  #advance(name, newest_s) {
    if (isSlow(name) && this.#hasEstimates) return;
    const isFirst = !isSlow(name) && !this.#hasEstimates;
    this.#hasEstimates ||= !isSlow(name);
    this.span.newest_s = isFirst ? newest_s : Math.max(newest_s, this.span.newest_s ?? -Infinity);
  }

  #trim(name, entry) {
    const times = entry.columns[0];
    const first = times.findIndex((time) => time >= this.span.from_s);
    // Removes many points at once instead of one per message.
    if (first > 200) entry.columns = entry.columns.map((column) => column.slice(first - 1));
    if (times.length > MOST_POINTS && !entry.refetching) {
      entry.refetching = true;
      this.fetch([name]).finally(() => (entry.refetching = false));
    }
  }

  #address(names, points) {
    const query = new URLSearchParams({ series: names.join(","), points });
    const from = this.span.isLive && this.span.newest_s === null ? null : this.span.from_s;
    if (from !== null) query.set("from", from);
    if (!this.span.isLive) query.set("to", this.span.to_s);
    return `/api/structures/${encodeURIComponent(this.structure)}/history?${query}`;
  }
}

/** Returns whether the points of a series are much rarer than estimates. */
function isSlow(name) {
  return name.startsWith("condition/") || name.startsWith("mode/");
}

/** Returns the rows after a time. */
function after(columns, time) {
  const first = columns[0].findIndex((one) => one > time);
  return first < 0 ? columns.map(() => []) : columns.map((column) => column.slice(first));
}

/** Returns one row with the last time, the least value of the first column and the largest of the second. */
function extremes([times, least, largest]) {
  const known = (column) => column.filter((value) => value !== null);
  const end = (column, of) => (known(column).length > 0 ? of(...known(column)) : null);
  return [times.slice(-1), [end(least, Math.min)], [end(largest, Math.max)]];
}

/** Appends rows in place, because copying every column ten times a second takes much work. */
function joined(columns, more) {
  columns.forEach((column, index) => column.push(...more[index]));
  return columns;
}
