// The waveforms of the sensors: the live ones as the server keeps them, ten pairs of extremes a second, and
// those of a range from the recording of ingest, with all of their samples.

import { t } from "./language.js";
import { Points } from "./span.js";
import { duration } from "./words.js";

/** Largest number of samples of all channels that the server reads at once. */
const MOST_SAMPLES = 1_000_000;
/** Length up to which a range is read from the recording even if the server keeps it (s). */
const FINE_S = 120;
/** Time for which a range must stay before it is read, because zooming passes many (ms). */
const SETTLE_MS = 400;

/** Number of attempts to read a range while the server is busy, and pause between two (ms). */
const [MOST_ATTEMPTS, RETRY_MS] = [3, 2000];

/** Returns the longest range whose samples the server reads at once (s). */
export function longestRange({ drawing: { sensors }, sampling_rate_hz: rate }) {
  return MOST_SAMPLES / (Math.max(sensors.length, 1) * rate);
}

/** The samples of one range, for all plots. */
export class Recording {
  #known = { range: null, read: null };
  /** Whether the server keeps points of any sensor in the chosen range. */
  hasPoints = false;

  constructor({ name, about }) {
    Object.assign(this, { name, isAtNodes: about.distributed, longest_s: longestRange(about), channels: about.drawing.sensors.map(({ channel }) => channel) });
  }

  /** Begins with another range [from, to] (s), or with live data (null). */
  choose(range) {
    if (range?.join() === this.#known.range?.join()) return;
    this.#known = { range, read: null };
    this.hasPoints = false;
  }

  /** Why the chosen range has no waveforms, or an empty text. */
  get why() {
    return this.hasPoints ? "" : (this.#known.why ?? "");
  }

  /** Reads the chosen range again if it could not be read. */
  restart() {
    if (this.#known.why) this.#known = { range: this.#known.range, read: null };
  }

  /** Returns the samples of the chosen range: times, and values by channel. Without any, only `why`. */
  read() {
    const known = this.#known;
    known.read ??= this.#read(known)
      .catch(() => ({ why: t("cannot-reach-spandrel") }))
      .then((read) => {
        known.why = read.why;
        return read;
      });
    return known.read;
  }

  async #read(known) {
    const [from_s, to_s] = known.range;
    if (to_s - from_s > this.longest_s) return { why: t("waveforms-of-shorter-ranges", duration(this.longest_s)) };
    await new Promise((done) => setTimeout(done, SETTLE_MS));
    if (known !== this.#known) return { why: "" };
    const query = new URLSearchParams({ from: from_s.toFixed(6), to: to_s.toFixed(6), format: "csv" });
    const response = await this.#fetch(known, query);
    if (response.ok) return parsed(await response.text(), this.channels);
    if (this.isAtNodes && [404, 503].includes(response.status)) return { why: t("waveforms-not-kept") };
    if (response.status === 404) return { why: t("waveforms-not-recorded") };
    const { error, allowed } = await response.json();
    return { why: t("waveforms-not-read", error, allowed) };
  }

  /** Fetches the samples, again after a pause while the server writes those of somebody else. */
  async #fetch(known, query) {
    for (let attempt = 1; ; attempt += 1) {
      const response = await fetch(`/api/structures/${encodeURIComponent(this.name)}/samples?${query}`);
      if (response.status !== 503 || this.isAtNodes || attempt === MOST_ATTEMPTS || known !== this.#known) return response;
      await new Promise((done) => setTimeout(done, RETRY_MS));
    }
  }
}

/** Reads a table of samples: a time (s), and a column per channel in the order of the structure file. */
function parsed(text, channels) {
  const lines = text.split("\n").slice(1).filter(Boolean);
  const times = new Float64Array(lines.length);
  const columns = new Map(channels.map((channel) => [channel, new Float32Array(lines.length)]));
  const all = [...columns.values()];
  lines.forEach((line, row) => {
    const [time, ...values] = line.split(",");
    times[row] = Number(time);
    all.forEach((column, index) => (column[row] = values[index] ? Number(values[index]) : NaN));
  });
  return { times, columns };
}

/** Returns the times and the extremes of samples in about `count` intervals of a range. */
export function envelope(times, values, { from_s, to_s, count }) {
  const step = Math.max((to_s - from_s) / count, 1e-9);
  const [at, least, largest] = [[], [], []];
  let interval = null;
  times.forEach((time, row) => {
    const value = values[row];
    if (Number.isNaN(value) || time < from_s || time > to_s) return;
    const own = Math.floor((time - from_s) / step);
    if (own !== interval) {
      interval = own;
      at.push(time);
      least.push(value);
      largest.push(value);
    } else {
      const last = at.length - 1;
      if (value < least[last]) least[last] = value;
      if (value > largest[last]) largest[last] = value;
    }
  });
  return [at, least, largest];
}

/** The points of waveforms, as `Points`. In a range, they are those of the recording where it has them. */
export class WaveformPoints {
  #recorded = new Map();
  #range = null;

  constructor(structure, span, recording, options = {}) {
    Object.assign(this, { structure, span, recording });
    // Live points are as far apart as those of the past. Otherwise the curve would change its look.
    this.kept = new Points(structure, span, { ...options, isThin: true, isEnvelope: true });
  }

  columns(name) {
    return (this.span.isLive ? null : this.#recorded.get(name)) ?? this.kept.columns(name);
  }

  csv(names) {
    return this.kept.csv(names);
  }

  take(series) {
    return this.kept.take(series);
  }

  clear() {
    this.kept.clear();
    this.#recorded.clear();
  }

  async fetch(names) {
    const { isLive, from_s, to_s } = this.span;
    const range = isLive ? null : [from_s, to_s];
    if (range?.join() !== this.#range) [this.#range, this.#recorded] = [range?.join(), new Map()];
    this.recording.choose(range);
    const came = await this.kept.fetch(names);
    if (isLive || range.join() !== this.#range) return came;
    const isEmpty = names.every((name) => !this.kept.columns(name)?.[0].length);
    const isFine = to_s - from_s <= Math.min(FINE_S, this.recording.longest_s);
    this.recording.hasPoints ||= !isEmpty;
    if (!isEmpty && !isFine) return came;
    const { times, columns: found } = await this.recording.read();
    // Without samples, the extremes that the server keeps are shown.
    if (!found || range.join() !== this.#range) return came;
    for (const name of names) {
      const values = found.get(name.slice(name.indexOf("/") + 1));
      const columns = values ? envelope(times, values, { from_s, to_s, count: this.kept.count }) : null;
      if (columns?.[0].length) this.#recorded.set(name, columns);
    }
    return true;
  }
}
