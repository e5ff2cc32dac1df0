// Small waveforms of many sensors, each with its state and one line of figures. They are drawn at most once
// a second, with few points, and only in the window.

import { h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { HOLE_STEPS, cleared, css } from "./plot.js";
import { HEALTH, clock, clockWords, levelWords, number, setSentence, time, unit } from "./words.js";
import { WaveformPoints } from "./waveforms.js";

/** Number of points of each waveform. A small plot is about twice as wide (px). */
const POINTS = 200;
/** Number of series in one request. The server allows 256. */
const SERIES_PER_REQUEST = 200;
/** Shortest and longest interval between two drawings (ms). */
const [DRAW_EVERY_MS, DRAW_AT_LEAST_EVERY_MS] = [1000, 10_000];
/** Shortest interval between two updates of the figures (ms). A message comes twice a second. */
const UPDATE_EVERY_MS = 900;
/** Margin of the scale above and below the data, as a share. */
const ROOM = 0.05;

export class SensorSmalls {
  #parts = new Map();
  #isFetched = false;
  #drawnAt = -Infinity;
  #updatedAt = -Infinity;
  #shown = null;
  /** Name of the sensor whose details are shown. The search removes its plot and creates it again. */
  #marked = null;

  /** `choose(channel)` opens the details of a sensor. */
  constructor(page, sensors, recording, choose) {
    Object.assign(this, { page, sensors, choose });
    this.points = new WaveformPoints(page.name, page.span, recording, { count: POINTS });
    this.grid = h("div", { class: "sensor-smalls" });
    this.limits = h("p", { class: "group-text", id: "waveform-scale" });
    this.none = h("p", { class: "empty", hidden: true }, t("no-sensor-matches-the-search"));
    this.element = h("div", {}, this.grid, this.none, this.limits);
    this.seen = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.#parts.get(target.dataset.channel).isSeen = isIntersecting;
      this.#drawnAt = -Infinity;
    });
    this.resized = new ResizeObserver(() => (this.#drawnAt = -Infinity));
    this.resized.observe(this.grid);
  }

  get names() {
    return [...this.sensors.keys()].map((channel) => `waveform/${channel}`);
  }

  /** Marks the sensor whose details are shown. */
  mark(channel) {
    this.#marked = channel;
    for (const [name, { element }] of this.#parts) element.setAttribute("aria-pressed", String(name === channel));
  }

  focus(channel) {
    this.#parts.get(channel)?.element.focus();
  }

  /** Shows the sensors in their order. `isReported` states whether ingest reports on clocks at all. */
  update(sensors, isReported) {
    // At most once a second, unless a sensor has another state or the search finds others.
    const shown = sensors.map(({ channel, health }) => `${channel} ${health}`).join();
    if (shown === this.#shown && performance.now() - this.#updatedAt < UPDATE_EVERY_MS) return;
    [this.#shown, this.#updatedAt] = [shown, performance.now()];
    this.none.hidden = sensors.length > 0;
    keyed(this.grid, sensors, ({ channel }) => channel, (sensor) => this.#make(sensor), (part, sensor) => this.#fill(part, sensor, isReported));
  }

  take(series) {
    this.points.take(series);
  }

  /** Fetches all waveforms at once. */
  restart() {
    this.points.clear();
    this.#isFetched = false;
    const { names } = this;
    const parts = Array.from({ length: Math.ceil(names.length / SERIES_PER_REQUEST) }, (_, index) => names.slice(index * SERIES_PER_REQUEST, (index + 1) * SERIES_PER_REQUEST));
    Promise.all(parts.map((part) => this.points.fetch(part).catch(() => false))).then(() => {
      this.#isFetched = true;
      this.#drawnAt = -Infinity;
    });
  }

  /** Draws the waveforms in the window if it is time, or all for a print. */
  draw({ isPrint = false } = {}) {
    const { min, max } = this.page.span.shown;
    const interval = Math.min(Math.max((500 * (max - min)) / POINTS, DRAW_EVERY_MS), DRAW_AT_LEAST_EVERY_MS);
    if (!isPrint && (!this.#isFetched || performance.now() - this.#drawnAt < interval)) return;
    this.#drawnAt = performance.now();
    const shown = [...this.#parts].filter(([, { element }]) => element.isConnected).map(([channel, part]) => ({ channel, ...part, columns: this.points.columns(`waveform/${channel}`) }));
    const ranges = new Map(shown.map(({ channel, columns }) => [channel, rangeOf(columns, min, max)]));
    const shared = new Map();
    for (const [channel, range] of ranges) {
      if (!range) continue;
      const { unit: of } = this.sensors.get(channel);
      const known = shared.get(of) ?? range;
      shared.set(of, [Math.min(known[0], range[0]), Math.max(known[1], range[1])]);
    }
    const { isCommon } = this.page.scale;
    const colours = Object.fromEntries(["--line-1", "--grid"].map((name) => [name, css(name)]));
    for (const part of shown) {
      const own = ranges.get(part.channel);
      if (isPrint || part.isSeen) paint(part, own && isCommon ? shared.get(this.sensors.get(part.channel).unit) : own, { min, max }, colours);
    }
    const scales = [...shared].map(([of, [low, high]]) => t("range-in-unit", number(low), number(high), unit(of)));
    const words = !isCommon ? t("each-plot-has-its-own-scale") : scales.length > 0 ? t("common-scale-of-waveforms", scales.join("; ")) : "";
    setSentence(this.limits, `${words}${t("time-of-the-small-plots", time(min), time(max))} ${t("figures-of-the-last-minute")}`);
  }

  #make({ channel }) {
    const parts = { sign: h("span", { class: "state", "aria-hidden": "true" }), word: h("span", { class: "word" }), last: h("span", { class: "last" }), canvas: h("canvas", { "aria-hidden": "true" }), figures: h("span", { class: "figures" }) };
    const element = h("button", { type: "button", class: "small-sensor", "aria-pressed": String(channel === this.#marked), "data-channel": channel, onclick: () => this.choose(channel) }, h("span", { class: "head" }, parts.sign, h("span", { class: "name" }, channel), parts.word, parts.last), parts.canvas, parts.figures);
    const part = { element, isSeen: false, ...parts };
    this.#parts.set(channel, part);
    this.seen.observe(element);
    return part;
  }

  #fill({ element, sign, word, last, figures }, { channel, health, level, clock: of }, isReported) {
    const state = HEALTH[health];
    element.dataset.level = state.level;
    setText(sign, state.sign);
    setText(word, state.level === "normal" ? "" : state.word);
    setText(last, level ? clock(level.last_s) : "");
    const [rate, , rms, peak] = levelWords(level, this.sensors.get(channel)?.unit ?? "");
    const words = level ? [`${rate} Hz`, `${t("rms")} ${rms}`, `${t("peak")} ${peak}`] : [t("no-sample")];
    const { clock: agreement } = clockWords(of, isReported && state.level === "normal");
    // A clock that agrees needs one sign.
    if (agreement !== "–") words.push(`${t("clock")} ${agreement === t("agrees") ? "✓" : agreement}`);
    setText(figures, words.join(" · "));
    element.title = [channel, state.word, ...(level ? [`${t("last-sample")}: ${time(level.last_s)}`] : []), ...words].join("\n");
    element.setAttribute("aria-label", `${channel}: ${state.word}, ${words.join(", ")}`);
  }
}

/** Returns the range of a waveform in a span, or null without data. */
function rangeOf(columns, min, max) {
  if (!columns) return null;
  let range = null;
  columns[0].forEach((at, row) => {
    const [low, high] = [columns[1][row], columns[2][row]];
    if (at < min || at > max || low === null || high === null) return;
    range = range ? [Math.min(range[0], low), Math.max(range[1], high)] : [low, high];
  });
  if (!range) return null;
  const room = ROOM * (range[1] - range[0]) || Math.abs(range[0]) * ROOM || 1e-9;
  return [range[0] - room, range[1] + room];
}

/** Draws a waveform between its extremes, and the line of zero. */
function paint({ canvas, columns }, range, { min, max }, colours) {
  const { ctx, width, height } = cleared(canvas);
  if (width === 0 || !range) return;
  const x = (at) => ((at - min) / (max - min)) * width;
  const y = (value) => height - ((value - range[0]) / (range[1] - range[0])) * height;
  const line = (points, colour, thickness) => {
    [ctx.strokeStyle, ctx.lineWidth, ctx.lineJoin] = [colour, thickness, "round"];
    ctx.beginPath();
    points.forEach(([left, top]) => ctx.lineTo(left, top));
    ctx.stroke();
  };
  if (range[0] < 0 && range[1] > 0) line([[0, y(0)], [width, y(0)]], colours["--grid"], 1);
  const rows = columns[0].map((_, row) => row).filter((row) => columns[1][row] !== null && columns[0][row] >= min && columns[0][row] <= max);
  const steps = rows.slice(1).map((row, index) => columns[0][row] - columns[0][rows[index]]);
  const usual = steps.toSorted((a, b) => a - b)[steps.length >> 1] ?? 0;
  let from = 0;
  for (let to = 1; to <= rows.length; to += 1) {
    if (to < rows.length && steps[to - 1] <= HOLE_STEPS * usual) continue;
    const piece = rows.slice(from, to);
    const [upper, lower] = [2, 1].map((column) => piece.map((row) => [x(columns[0][row]), y(columns[column][row])]));
    ctx.fillStyle = colours["--line-1"];
    ctx.beginPath();
    [...upper, ...lower.toReversed()].forEach(([left, top]) => ctx.lineTo(left, top));
    ctx.fill();
    // The extremes of fine samples are equal, so that the area between them is empty.
    line(upper, colours["--line-1"], 1);
    line(lower, colours["--line-1"], 1);
    from = to;
  }
}
