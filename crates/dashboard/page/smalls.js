// Small plots of many parameters, so that all of them fit a screen. They are drawn at most once a
// second, with few points, and only in the window.

import { h, setText } from "./dom.js";
import { t } from "./language.js";
import { cleared, css } from "./plot.js";
import { Points } from "./span.js";
import { ratio, setSentence, stateOf, time } from "./words.js";

/** Number of points of each parameter. A small plot is about as wide (px). */
const POINTS = 150;
/**
 * Shortest and longest interval between two drawings (ms). In a long span, a second is less than a
 * point.
 */
const [DRAW_EVERY_MS, DRAW_AT_LEAST_EVERY_MS] = [1000, 10_000];
/**
 * Sizes of the small plots (px): smallest width and height of one, height of the name above its curve, and
 * gap between two. The dense ones are for so many that the usual ones do not fit the window.
 */
const USUAL = { narrowest: 128, lowest: 72, head: 26, gap: 7, isDense: false };
const DENSE = { narrowest: 92, lowest: 40, head: 21, gap: 4, isDense: true };
/** Largest height of a small plot, and height of a dense one where not all fit the window (px). */
const HIGHEST = 230;
const UNFIT = 60;
/** Smallest height that all small plots together may take (px). */
const LEAST_HEIGHT = 320;
/** Room below the small plots for their scale (px). */
const BELOW = 50;
/** Change of the height of the window for which the plots keep their places (px). */
const BARS = 120;
/** Height from which a plot shows the ends of its scale (px). */
const LABELLED_FROM = 70;
/** Half-width of the 95 % interval of a Gaussian, in standard deviations. */
const HALF_95 = 1.96;
/** Share of the widest intervals, as at the start, that the scale leaves out. */
const LEFT_OUT = 0.05;
/** Shortest interval between two updates of the numbers (ms). A message comes twice a second. */
const UPDATE_EVERY_MS = 900;
/** Smallest margin of the scale above and below the data, as a ratio to the design. */
const LEAST_ROOM = 0.005;

export class SmallPlots {
  /** An element above the plots that comes and goes. */
  above = null;
  #parts;
  #isFetched = false;
  #drawnAt = -Infinity;
  #updatedAt = -Infinity;
  /** Height of the window for which the plots are arranged (px). */
  #window = 0;
  /** The words of the alerts that were shown last. */
  #levels = null;

  constructor(page, choose) {
    this.page = page;
    this.points = new Points(page.name, page.span, { count: POINTS, isThin: true });
    this.#parts = page.about.parameters.map((parameter) => {
      const [value, state, canvas] = [h("span", { class: "value" }), h("span", { class: "state", "aria-hidden": "true" }), h("canvas", { "aria-hidden": "true" })];
      const element = h("button", { type: "button", class: "small-plot", "aria-pressed": "false", "data-parameter": parameter.name, title: parameter.name, onclick: () => choose(parameter.name) }, h("span", { class: "name" }, parameter.name), state, value, canvas);
      return { parameter, name: `parameter/${parameter.name}`, element, value, state, canvas };
    });
    this.limits = h("p", { class: "group-text", id: "small-scale" });
    this.grid = h("div", { class: "smalls" }, this.#parts.map(({ element }) => element));
    this.none = h("p", { class: "empty", hidden: true }, t("no-part-matches-the-search"));
    this.element = h("div", {}, this.grid, this.none, this.limits);
    this.resized = new ResizeObserver(() => this.#arrange());
    this.resized.observe(this.grid);
    const parts = new Map(this.#parts.map((part) => [part.element, part]));
    this.seen = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) parts.get(target).isSeen = isIntersecting;
      this.#drawnAt = -Infinity;
    });
    for (const element of parts.keys()) this.seen.observe(element);
  }

  /** Shows only the parameters whose names `finds` accepts. */
  filter(finds) {
    for (const { parameter, element } of this.#parts) element.hidden = !finds(parameter.name);
    this.none.hidden = this.#shown.length > 0;
    this.#arrange();
    this.#drawnAt = -Infinity;
  }

  /** Marks the parameter whose details are shown. */
  mark(name) {
    for (const { parameter, element } of this.#parts) element.setAttribute("aria-pressed", String(parameter.name === name));
  }

  focus(name) {
    this.#parts.find(({ parameter }) => parameter.name === name)?.element.focus();
  }

  /** Shows the newest values, at most once a second unless an alert changes. */
  update(standing) {
    const alerts = new Map(standing.alerts.map((alert) => [alert.parameter, alert]));
    const levels = standing.alerts.map((alert) => stateOf(alert).word).join();
    if (levels === this.#levels && performance.now() - this.#updatedAt < UPDATE_EVERY_MS) return;
    [this.#levels, this.#updatedAt] = [levels, performance.now()];
    for (const { parameter, element, value, state } of this.#parts) {
      const shown = standing.parameters[parameter.name];
      const alert = alerts.get(parameter.name);
      const of = alert ? stateOf(alert) : { level: "learning", sign: "", word: t("no-decision") };
      element.dataset.level = of.level;
      setText(state, of.sign);
      setText(value, shown ? ratio(shown.mean) : "–");
      element.setAttribute("aria-label", `${parameter.name}: ${shown ? `${ratio(shown.mean)} ± ${ratio(shown.std)}` : t("no-estimate")}, ${of.word}`);
    }
  }

  take(series) {
    this.points.take(series);
  }

  /** Fetches all parameters at once. */
  restart() {
    this.points.clear();
    this.#isFetched = false;
    this.points.fetch(this.#parts.map(({ name }) => name)).catch(() => false).then(() => {
      this.#isFetched = true;
      this.#drawnAt = -Infinity;
    });
  }

  /** Draws the plots in the window if it is time, or all plots for a print. */
  draw({ isPrint = false } = {}) {
    // The bars of a phone's browser come and go while people scroll.
    if (!isPrint && Math.abs(innerHeight - this.#window) > BARS) this.#arrange();
    const { min, max } = this.page.span.shown;
    const interval = Math.min(Math.max((500 * (max - min)) / POINTS, DRAW_EVERY_MS), DRAW_AT_LEAST_EVERY_MS);
    if (!isPrint && (!this.#isFetched || performance.now() - this.#drawnAt < interval)) return;
    this.#drawnAt = performance.now();
    const shown = this.#shown.map((part) => ({ ...part, columns: this.points.columns(part.name) }));
    const ranges = shown.map((part) => this.#range(part));
    const { scale } = this.page;
    const stiff = ranges.filter((range, index) => range && shown[index].parameter.stiffness);
    const shared = stiff.length > 0 ? [Math.min(...stiff.map(([low]) => low)), Math.max(...stiff.map(([, high]) => high))] : null;
    const colours = Object.fromEntries(["--line-1", "--band-95", "--alarm", "--grid", "--ink-soft"].map((name) => [name, css(name)]));
    shown.forEach((part, index) => (isPrint || part.isSeen) && this.#paint(part, scale.isCommon && part.parameter.stiffness ? shared : ranges[index], colours));
    const limits = scale.isCommon && shared ? t("common-scale-of-all-stiffnesses-to", ratio(shared[0]), ratio(shared[1])) : t("each-plot-has-its-own-scale");
    setSentence(this.limits, limits + t("time-of-the-small-plots", time(min), time(max)));
  }

  get #shown() {
    return this.#parts.filter(({ element }) => !element.hidden);
  }

  #threshold({ parameter }) {
    const loss = this.page.standing()?.losses[parameter.name];
    return loss && parameter.stiffness ? (1 - loss.rule_loss) * loss.reference : null;
  }

  /** Returns the range that one parameter needs, or null without data. */
  #range(part) {
    if (!part.columns || part.columns[0].length === 0) return null;
    const { min, max } = this.page.span.shown;
    const [times, means, stds] = part.columns;
    const seen = times.map((_, row) => row).filter((row) => times[row] >= min && times[row] <= max && means[row] !== null);
    if (seen.length === 0) return null;
    const sorted = (sign) => seen.map((row) => means[row] + sign * HALF_95 * stds[row]).sort((a, b) => a - b);
    const at = Math.round(LEFT_OUT * (seen.length - 1));
    const ends = [sorted(-1)[at], sorted(1).at(-1 - at), this.#threshold(part)].filter((end) => end !== null);
    const [low, high] = [Math.min(...ends), Math.max(...ends)];
    const room = Math.max(0.06 * (high - low), LEAST_ROOM);
    return [low - room, high + room];
  }

  #paint(part, range, colours) {
    const { canvas, columns } = part;
    const { ctx, width, height } = cleared(canvas);
    if (width === 0 || !range) return;
    const { min, max } = this.page.span.shown;
    const x = (time) => ((time - min) / (max - min)) * width;
    const y = (value) => height - ((value - range[0]) / (range[1] - range[0])) * height;
    const line = (value, colour, dash) => {
      if (value === null || value < range[0] || value > range[1]) return;
      ctx.setLineDash(dash);
      [ctx.strokeStyle, ctx.lineWidth] = [colour, 1];
      ctx.beginPath();
      ctx.moveTo(0, y(value));
      ctx.lineTo(width, y(value));
      ctx.stroke();
      ctx.setLineDash([]);
    };
    line(1, colours["--grid"], []);
    const [times, means, stds] = columns;
    const rows = times.map((_, row) => row).filter((row) => means[row] !== null && times[row] >= min);
    ctx.fillStyle = colours["--band-95"];
    ctx.beginPath();
    for (const row of rows) ctx.lineTo(x(times[row]), y(means[row] - HALF_95 * stds[row]));
    for (const row of rows.toReversed()) ctx.lineTo(x(times[row]), y(means[row] + HALF_95 * stds[row]));
    ctx.fill();
    [ctx.strokeStyle, ctx.lineWidth, ctx.lineJoin] = [colours["--line-1"], 1.5, "round"];
    ctx.beginPath();
    for (const row of rows) ctx.lineTo(x(times[row]), y(means[row]));
    ctx.stroke();
    line(this.#threshold(part), colours["--alarm"], [4, 3]);
    if (height < LABELLED_FROM) return;
    [ctx.fillStyle, ctx.font, ctx.textAlign] = [colours["--ink-soft"], "10px system-ui, sans-serif", "left"];
    ctx.fillText(ratio(range[1]), 1, 9);
    ctx.fillText(ratio(range[0]), 1, height - 2);
  }

  /** Chooses the number of columns with which the plots fit the window and fill it best. */
  #arrange() {
    const width = this.grid.clientWidth;
    const count = this.#shown.length;
    if (width === 0 || count === 0) return;
    this.#window = innerHeight;
    // The details of a parameter are above the plots and may push them out of the window, but must not
    // arrange them anew.
    const above = this.above && !this.above.hidden ? this.above.offsetHeight : 0;
    const top = this.grid.getBoundingClientRect().top + scrollY - above;
    const room = Math.max(innerHeight - top - BELOW, LEAST_HEIGHT);
    const best = fitting(USUAL, { width, count, room }) ?? fitting(DENSE, { width, count, room }) ?? { ...DENSE, columns: mostColumns(DENSE, width, count), height: UNFIT };
    this.grid.style.setProperty("--columns", best.columns);
    this.grid.style.setProperty("--height", `${Math.floor(best.height - best.head)}px`);
    this.grid.classList.toggle("is-dense", best.isDense);
    // A name is more important than the value, which the label contains too.
    this.grid.classList.remove("is-tight");
    this.grid.classList.toggle("is-tight", this.#shown.some(({ element }) => element.firstChild.scrollWidth > element.firstChild.clientWidth));
    this.#drawnAt = -Infinity;
  }
}

function mostColumns({ narrowest, gap }, width, count) {
  return Math.max(1, Math.min(count, Math.floor((width + gap) / (narrowest + gap))));
}

/** Returns the columns and the height with which plots of a size fit the room and fill it best, or null. */
function fitting(size, { width, count, room }) {
  const { lowest, gap } = size;
  const choices = Array.from({ length: mostColumns(size, width, count) }, (_, index) => {
    const columns = index + 1;
    const rows = Math.ceil(count / columns);
    const height = Math.min(Math.max(room / rows - gap, lowest), HIGHEST);
    // Empty places are lost.
    return { ...size, columns, height, taken: rows * (height + gap), score: (count / (rows * columns)) * rows * (height + gap) };
  });
  const fits = choices.filter(({ taken }) => taken <= room + gap);
  return fits.length > 0 ? fits.reduce((best, one) => (one.score > best.score ? one : best)) : null;
}
