// One plot over time, drawn with uPlot: the page's colours, a shared crosshair, marks, and export
// to a file.

import { h, s, setText } from "./dom.js";
import { inLanguage, t } from "./language.js";
import { flags } from "./marks.js";
import { shapeKey } from "./shapes.js";
import { clock, isLocal, isWithoutDate, moment, powerOfTen, recordTime, typeset, zone } from "./words.js";

/* global uPlot */

const HEIGHT = 220;
/**
 * Height of a row of labels above a plot, size of the labels, and room above a plot without labels
 * (px).
 */
const WORD_ROW = 15;
const WORD_SIZE = 12;
const TOP_ROOM = 8;
/**
 * Widths at which a plot is drawn for paper (px), beside another one or alone in its row. The style sheet
 * shrinks both to their place by the same factor, so that all plots of a page have letters of one size.
 */
const PAPER = { half: 450, whole: 954 };
/** Minimum gap in time, in usual steps, that no line crosses. A busy service publishes every tenth value. */
export const HOLE_STEPS = 12;

/** Width of a character of the y axis (px). */
const CHARACTER = 7;
const [MINUTE_S, HOUR_S, DAY_S] = [60, 3600, 86400];
/** Possible distances of the times of an axis (s). The usual ones of uPlot lack 2 s, 2 min and 20 min. */
const TIME_STEPS = [
  ...[0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30],
  ...[1, 2, 5, 10, 15, 20, 30].map((minutes) => MINUTE_S * minutes),
  ...[1, 2, 3, 4, 6, 8, 12].map((hours) => HOUR_S * hours),
  ...[1, 2, 3, 4, 5, 7, 10, 15, 30, 60, 90, 120, 180, 365, 730, 1825, 3650].map((days) => DAY_S * days),
];

/** Colours of lines, distinguishable with red-green colour blindness (Okabe and Ito). */
export const COLOURS = ["--line-1", "--line-2", "--line-3", "--line-4", "--line-5", "--line-6", "--line-7"];
/** Dashes that distinguish lines without colour. */
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3], [4, 4], [14, 4], [1, 5]];

/**
 * Returns the colour and dash of a line. They differ for as many lines as there are pairs of both.
 */
export function look(index) {
  const rounds = Math.floor(index / COLOURS.length);
  return { colour: COLOURS[index % COLOURS.length], dash: DASHES[(index + rounds) % DASHES.length] };
}

export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Clears a canvas and fits it to its size on the page. Returns its context, in px of the page, and this size. */
export function cleared(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const size = devicePixelRatio;
  const [across, down] = [Math.round(width * size), Math.round(height * size)];
  if (canvas.width !== across || canvas.height !== down) [canvas.width, canvas.height] = [across, down];
  const ctx = canvas.getContext("2d");
  ctx.setTransform(size, 0, 0, size, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return { ctx, width, height };
}

export class Plot {
  #uplot = null;
  #isSeen = false;
  #isDirty = true;
  #wasFetched = false;
  #wasTried = false;

  /**
   * `plot` has these fields:
   * - `title`, `unit`, `names`: title, unit and names of the series
   * - `series`, `bands`: series and bands of uPlot
   * - `rows(columns by name)`: returns the data of uPlot
   * - `readout(data, index)`: returns a text
   * - `marks()`: returns lines { y, text, colour, isBelow } or { x, text, colour }, the most important
   *   labels first. `isBelow`: the label is below its line, because most values are above. `isSolid`:
   *   the line has no dashes
   * - `range`: range of the y axis, if it is fixed
   * - `legend`: list of { name, colour } with a `dash` of a line, or a `shape` of points
   * - `paint(uPlot)`: draws what uPlot does not draw, such as points of several shapes
   * - `at(x)`: returns the text of a time, if it is not a moment
   * - `isLogarithmic`: whether both axes are logarithmic
   * - `hasLogarithmicY`: whether the y axis is logarithmic
   * - `isContinuous`: whether gaps in time need no empty rows
   * - `across()`: returns the title of the x axis, if it does not show the time
   * - `height`: height (px)
   * - `sync`: name of the plots that share the crosshair
   * - `newest(data)`: index of the row that is read without a crosshair, if it is not the last one
   * - `isSinceStart`: whether the times are since the start of a range
   */
  constructor(plot, points, span) {
    Object.assign(this, { plot, points, span });
    this.readout = h("p", { class: "readout" });
    const keys = t("arrow-keys-move-the-crosshair-shift-and");
    this.holder = h("div", { class: "plot-holder", tabindex: "0", role: "application", "aria-label": `${plot.title}: ${keys}`, onkeydown: (event) => this.#key(event) });
    this.holder.style.minHeight = `${this.#height}px`;
    const legend = (plot.legend ?? []).map(({ name, colour, dash, shape, isHollow }) => {
      // An area, or a line with its dashes.
      const drawn = () => s("svg", { class: "key-line", width: 32, height: 8, "aria-hidden": "true" }, s("line", { x1: 0, y1: 4, x2: 32, y2: 4, "stroke-dasharray": dash.join(" ") }));
      const key = shape ? shapeKey({ shape, isHollow }) : dash ? drawn() : h("span", { class: "key", "aria-hidden": "true" });
      key.style.setProperty("--key", `var(${colour})`);
      return h("li", {}, key, name);
    });
    const csv = h("a", { class: "button small", href: "#", onclick: (event) => (event.currentTarget.href = points.csv(plot.names)), download: `${points.structure}-${plot.file}.csv` }, "CSV");
    const png = h("button", { class: "small", type: "button", onclick: () => this.#png() }, "PNG");
    csv.setAttribute("aria-label", t("download-as-csv", plot.title));
    png.setAttribute("aria-label", t("download-as-png", plot.title));
    this.head = h("div", { class: "plot-head" }, h("h3", {}, plot.title), h("span", { class: "files" }, csv, png));
    const key = legend.length > 0 ? h("ul", { class: "legend" }, legend) : [];
    this.element = h("section", { class: "plot", id: `plot-${plot.id ?? plot.file}` }, this.head, this.readout, key, this.holder);
    this.seen = new IntersectionObserver((entries) => this.#see(entries.at(-1).isIntersecting), { rootMargin: "200px" });
    this.seen.observe(this.element);
    this.resized = new ResizeObserver(() => this.#resize());
    this.resized.observe(this.holder);
  }

  /** Adds a key of colours above the plot. Returns a function that writes its ends. */
  key(look, unit) {
    const [low, high] = [h("span"), h("span")];
    this.readout.after(h("p", { class: "colour-key" }, low, h("span", { class: `ramp is-${look}`, "aria-hidden": "true" }), high, ` ${unit}`));
    return (least, most) => {
      setText(low, least);
      setText(high, most);
    };
  }

  /** Shows another title, once it is known what the plot shows. */
  retitle(title) {
    this.plot.title = title;
    setText(this.head.firstChild, title);
  }

  close() {
    this.seen.disconnect();
    this.resized.disconnect();
    this.#uplot?.destroy();
    this.#uplot = null;
  }

  /** Refetches the data after a change of the span. */
  restart() {
    this.#wasFetched = this.#wasTried = false;
    this.#isDirty = true;
    if (this.#isSeen) this.fetch();
  }

  /** Stops all work while the tab is hidden. */
  hide() {
    this.seen.disconnect();
    this.#isSeen = this.#wasFetched = this.#wasTried = false;
    this.#isDirty = true;
  }

  /** Starts work again. The observer reports at once whether the plot is in the window. */
  show() {
    this.seen.disconnect();
    this.seen.observe(this.element);
  }

  /** Whether the data of the span has not been requested. */
  get isUnfetched() {
    return !this.#wasTried;
  }

  /** Redraws after a change of the colours. */
  recolour() {
    this.#uplot?.destroy();
    this.#uplot = null;
    this.#isDirty = true;
    this.draw();
  }

  /** Requests a redraw for new points or marks. */
  dirty() {
    this.#isDirty = true;
  }

  /** Draws if there is new data and the plot is visible. */
  draw() {
    if (this.#isSeen && this.#isDirty) this.drawNow();
  }

  /** Draws the plot even if it is outside the window, as for a print. */
  drawNow() {
    if (this.holder.clientWidth === 0) return;
    this.#isDirty = false;
    const data = this.#data();
    const isEmpty = !data || data[0].length === 0;
    this.element.classList.toggle("is-empty", isEmpty);
    if (isEmpty) {
      const isLate = this.plot.names.some((name) => this.span.late?.has(name));
      setText(this.readout, isLate ? t("history-did-not-answer-in-time") : this.#wasFetched ? t("no-data-in-this-span") : t("plot-loading"));
      return;
    }
    const isNew = !this.#uplot;
    this.#uplot ??= new uPlot(this.#options(), data, this.holder);
    this.#uplot.batch((u) => {
      if (!isNew) u.setData(data, false);
      u.setScale("x", this.span.shown);
    });
    // A new mark in the same span changes the room above the plot.
    const { room } = this;
    if (this.#room(this.#uplot) !== room) this.#uplot.redraw(false, true);
    // Reads the value at the crosshair again. uPlot keeps the number of its row, which is another
    // moment in refetched data.
    const { left, top } = this.#uplot.cursor;
    this.#uplot.setCursor({ left, top });
  }

  /** Draws the plot in its size on paper, or again in that of the window. */
  print(isOnPaper) {
    if (isOnPaper) this.drawNow();
    const isWhole = !this.element.parentElement?.matches(".plots") || getComputedStyle(this.element).gridColumnEnd === "-1";
    if (!isOnPaper) this.#resize();
    else this.#uplot?.setSize({ width: isWhole ? PAPER.whole : PAPER.half, height: this.#height });
  }

  /** Provides the functions of the mouse by keyboard. */
  #key(event) {
    if (!this.#uplot || event.ctrlKey || event.altKey || event.metaKey) return;
    const { min, max } = this.span.shown;
    const direction = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const factor = { "+": 0.5, "=": 0.5, "-": 2, _: 2 }[event.key];
    if (direction && event.shiftKey) {
      const step = 0.25 * direction * (max - min);
      this.span.fix(min + step, max + step);
    } else if (direction) {
      this.#step(direction);
    } else if (factor) {
      const data = this.#uplot.data[0];
      const middle = data[this.#uplot.cursor.idx] ?? (min + max) / 2;
      this.span.fix(middle - factor * (middle - min), middle + factor * (max - middle));
    } else if (event.key === "Home") {
      this.span.live(this.span.length_s);
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Moves the crosshair of all plots by one point of this plot, within the visible range. */
  #step(direction) {
    const u = this.#uplot;
    const times = u.data[0];
    const { min, max } = u.scales.x;
    let index = u.cursor.idx ?? null;
    if (index === null) index = direction > 0 ? times.findIndex((time) => time >= min) : times.findLastIndex((time) => time <= max);
    else index = Math.min(index, times.length) + direction; // refetched data may have fewer rows
    const time = times[index];
    if (time === undefined || time < min || time > max) return;
    u.setCursor({ left: u.valToPos(time, "x"), top: u.over.clientHeight / 2 }, true, true);
  }

  #see(isSeen) {
    this.#isSeen = isSeen;
    if (isSeen && !this.#wasTried) this.fetch();
    if (isSeen) this.draw();
  }

  /** Requests the data of the span. */
  fetch() {
    this.#wasFetched = false;
    this.#wasTried = true;
    this.points.fetch(this.plot.names).catch(() => false).then((came) => {
      this.#wasFetched = came;
      this.#isDirty = true;
      this.draw();
    });
  }

  #data() {
    const columns = new Map(this.plot.names.map((name) => [name, this.points.columns(name)]));
    if ([...columns.values()].every((one) => one === null)) return null;
    const rows = this.plot.rows(columns);
    return this.plot.across || this.plot.isSinceStart || this.plot.isContinuous ? rows : withHoles(rows);
  }

  #read(index) {
    const data = this.#uplot.data;
    const last = lastOf(data);
    // Refetched data may have fewer rows than the crosshair's index.
    const newest = this.plot.newest?.(data) ?? last;
    const at = last === null ? null : Math.min(index ?? (newest < 0 ? last : newest), last);
    const at_s = this.plot.at ?? (this.plot.isSinceStart ? recordTime : clock);
    const when = this.plot.across ? "" : `${at_s(data[0][at ?? 0])} · `;
    const text = at === null ? "" : `${when}${this.plot.readout(data, at)}`;
    setText(this.readout, text);
  }

  get #height() {
    return this.plot.height ?? HEIGHT;
  }

  #resize() {
    const width = this.holder.clientWidth;
    if (this.#uplot && width > 0 && width !== this.#uplot.width) this.#uplot.setSize({ width, height: this.#height });
  }

  #options() {
    const isNarrow = this.holder.clientWidth < 520;
    const { across } = this.plot;
    const isLogarithmicX = Boolean(this.plot.isLogarithmic);
    const isLogarithmicY = isLogarithmicX || Boolean(this.plot.hasLogarithmicY);
    const axisOf = (isLogarithmic) => {
      // uPlot otherwise draws nine lines for each decade.
      const filter = (_, ticks) => (isLogarithmic ? ticks.map((tick) => (isDecade(tick) ? tick : null)) : ticks);
      return { stroke: css("--ink-soft"), grid: { stroke: css("--grid"), width: 1, filter }, ticks: { stroke: css("--grid"), filter }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    };
    const labelOf = (isLogarithmic) => (isLogarithmic ? power : compact);
    const [xAxis, yAxis] = [axisOf(isLogarithmicX), axisOf(isLogarithmicY)];
    return {
      width: this.holder.clientWidth,
      height: this.#height,
      padding: [(u) => this.#room(u), null, null, null],
      legend: { show: false },
      tzDate: (seconds) => (isLocal() ? new Date(1000 * seconds) : uPlot.tzDate(new Date(1000 * seconds), "Etc/UTC")),
      cursor: { sync: { key: across ? null : (this.plot.sync ?? "span") }, drag: { x: true, y: false, setScale: false }, points: { show: false } },
      scales: { x: { time: !across, distr: isLogarithmicX ? 3 : 1 }, y: { range: this.plot.range ?? padded, distr: isLogarithmicY ? 3 : 1 } },
      axes: [
        across
          ? { ...xAxis, space: isNarrow ? 50 : 70, values: (_, ticks) => ticks.map(labelOf(isLogarithmicX)), label: across, labelSize: 18 }
          : { ...xAxis, incrs: TIME_STEPS, space: (_, axis, min, max) => (!isNarrow ? 90 : this.plot.at ? 86 : narrowSpace(min, max)), values: (_, splits, index, space, step) => timeTicks(splits, step), label: (u) => (this.plot.isSinceStart ? t("time-since-the-start-h-min-s") : isWithoutDate(u.scales.x.max) ? t("time-of-the-record-h-min-s") : t("axis-time", zone(u.scales.x.max))), labelSize: 18 },
        { ...yAxis, label: this.plot.unit, labelSize: 20, space: 24, size: (_, values) => Math.max(isNarrow ? 54 : 62, CHARACTER * Math.max(0, ...(values ?? []).map((text) => text?.length ?? 0)) + 16), values: (_, ticks) => ticks.map((tick) => this.plot.tick?.(tick) ?? labelOf(isLogarithmicY)(tick)) },
      ],
      series: [{}, ...this.plot.series().map((one) => ({ points: { show: false }, ...one }))],
      bands: this.plot.bands?.() ?? [],
      hooks: {
        draw: [(u) => this.plot.paint?.(u), (u) => this.#marks(u)],
        setCursor: [(u) => this.#read(u.cursor.idx ?? null)],
        setSelect: [(u) => this.#zoom(u)],
      },
    };
  }

  #zoom(u) {
    const { left, width } = u.select;
    if (width < 8) return;
    const [from, to] = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.span.fix(from, to);
  }

  /** Returns the room above the plot for the labels of its marks (px). */
  #room(u) {
    const rows = this.#flags(u).reduce((most, { row }) => Math.max(most, row + 1), 0);
    return (this.room = rows > 0 ? rows * WORD_ROW + 4 : TOP_ROOM);
  }

  /** Returns the visible marks of moments with the places of their labels. */
  #flags(u) {
    const { ctx } = u;
    ctx.save(); // uPlot caches its settings and does not set them again
    ctx.font = `${WORD_SIZE}px system-ui, sans-serif`;
    const width = u.bbox.width / devicePixelRatio || this.holder.clientWidth;
    const place = this.plot.isLogarithmic ? Math.log : (x) => x;
    const marks = (this.plot.marks?.() ?? []).map((mark) => (mark.x === undefined ? mark : { ...mark, x: place(mark.x) }));
    const { min, max } = u.scales.x;
    const all = flags(marks, { min: place(min), max: place(max) }, width, (text) => ctx.measureText(text).width);
    ctx.restore();
    return all;
  }

  #marks(u) {
    const { ctx, bbox } = u;
    const size = devicePixelRatio;
    const flags = this.#flags(u);
    ctx.save();
    ctx.font = `${WORD_SIZE * size}px system-ui, sans-serif`;
    [ctx.textAlign, ctx.textBaseline] = ["left", "alphabetic"];
    const line = (colour, dash, from, to) => {
      [ctx.strokeStyle, ctx.lineWidth] = [colour, 1.5 * size];
      ctx.setLineDash(dash.map((length) => length * size));
      ctx.beginPath();
      ctx.moveTo(...from);
      ctx.lineTo(...to);
      ctx.stroke();
    };
    // With an outline, so that no line strikes through the text. A plate would hide the curve behind it.
    const write = (text, x, y, colour, plate) => {
      ctx.fillStyle = ctx.strokeStyle = css(plate ?? "--card");
      ctx.setLineDash([]);
      [ctx.lineWidth, ctx.lineJoin] = [3 * size, "round"];
      if (plate) ctx.fillRect(x - 2 * size, y - 11 * size, ctx.measureText(text).width + 4 * size, 14 * size);
      else ctx.strokeText(text, x, y);
      ctx.fillStyle = colour;
      ctx.fillText(text, x, y);
    };
    const [left, right, bottom] = [bbox.left, bbox.left + bbox.width, bbox.top + bbox.height];
    const texts = [];
    for (const mark of this.plot.marks?.() ?? []) {
      if (mark.y === undefined) continue;
      const y = u.valToPos(mark.y, "y", true);
      if (y < bbox.top || y > bottom) continue;
      const colour = css(mark.colour ?? "--ink-soft");
      line(colour, mark.isSolid ? [] : [6, 4], [left, y], [right, y]);
      const isBelow = mark.isBelow ? y < bottom - 16 * size : y < bbox.top + 16 * size;
      const at = isBelow ? y + 15 * size : y - 5 * size;
      const wide = ctx.measureText(mark.text).width + 12 * size;
      // The label is at the left, unless it would cover the curve there and not at the right.
      const isAtRight = mark.isBelow && this.#isCurveIn(u, left, left + wide, at) && !this.#isCurveIn(u, right - wide, right, at);
      // A label that would cover a more important one is left out.
      if (mark.text && texts.every(([, , other]) => Math.abs(other - at) >= WORD_ROW * size)) texts.push([mark.text, isAtRight ? right - wide + 6 * size : left + 6 * size, at, colour, mark.plate]);
    }
    // Extends the line up to its label.
    for (const { at, row, colour } of flags) line(css(colour), [2, 3], [left + at * size, bbox.top - (row + 1) * WORD_ROW * size], [left + at * size, bottom]);
    for (const { text, colour, row, from } of flags.filter(({ row }) => row >= 0)) texts.push([text, left + from * size, bbox.top - (row * WORD_ROW + 4) * size, css(colour)]);
    texts.forEach((text) => write(...text));
    ctx.restore();
  }

  /** Returns whether the first curve passes a label at a height, between two places (px of the canvas). */
  #isCurveIn(u, from, to, at) {
    const size = devicePixelRatio;
    const [times, values] = u.data;
    const [first, last] = [from, to].map((x) => u.posToVal((x - u.bbox.left) / size, "x"));
    const heights = values.map((value) => (value == null ? null : u.valToPos(value, "y", true)));
    return times.some((time, row) => {
      const before = heights[row - 1] ?? heights[row];
      // A sudden drop crosses the label between two values.
      if (heights[row] === null || time < first || (times[row - 1] ?? time) > last) return false;
      return Math.max(before, heights[row]) > at - WORD_ROW * size && Math.min(before, heights[row]) < at + 4 * size;
    });
  }

  /** Saves the visible plot to a file, with its title and background. */
  #png() {
    if (!this.#uplot) return;
    const source = this.#uplot.ctx.canvas;
    const head = 30 * devicePixelRatio;
    const canvas = h("canvas", { width: source.width, height: source.height + head });
    const ctx = canvas.getContext("2d");
    ctx.fillStyle = css("--card");
    ctx.fillRect(0, 0, canvas.width, canvas.height);
    ctx.fillStyle = css("--ink");
    ctx.font = `bold ${14 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.fillText(`${this.points.structure}: ${this.plot.title}`, 10 * devicePixelRatio, 20 * devicePixelRatio);
    ctx.drawImage(source, 0, head);
    canvas.toBlob((blob) => {
      const address = URL.createObjectURL(blob);
      h("a", { href: address, download: `${this.points.structure}-${this.plot.file}.png` }).click();
      setTimeout(() => URL.revokeObjectURL(address), 1000);
    });
  }
}

/** Returns a range with a small margin, which is not empty for a constant line. */
export function padded(_, least, largest) {
  if (least === null || largest === null || !Number.isFinite(least)) return [0, 1];
  const room = Math.max((largest - least) * 0.08, Math.abs(largest) * 0.01, 1e-12);
  return [least - room, largest + room];
}

/**
 * Returns the smallest distance of two times on a narrow axis (px). Two dates and fractions of a second are
 * the longest, and times of one day without seconds are the shortest.
 */
function narrowSpace(min, max) {
  if (isWithoutDate(max)) return 70;
  const length_s = max - min;
  if (length_s < 10 || moment(min).date !== moment(max).date) return 86;
  return length_s < 10 * MINUTE_S - 1 ? 60 : 48;
}

/**
 * Formats the times of the axis at the resolution of its steps, with the date where it changes. A
 * record without dates shows its own time.
 */
export function timeTicks(splits, step) {
  if (splits.length > 0 && isWithoutDate(splits.at(-1))) return splits.map((split) => recordTime(split, step >= 1 ? 0 : step >= 0.1 ? 1 : 3));
  let date = "";
  return splits.map((split) => {
    const { date: day, clock } = moment(split);
    if (step >= 28 * 86400) return inLanguage(day.slice(0, -3));
    if (step >= 86400) return inLanguage(day);
    const time = step >= 60 ? clock.slice(0, 5) : step >= 1 ? clock.slice(0, 8) : inLanguage(clock);
    const isNewDate = day !== date;
    date = day;
    return isNewDate ? `${time}\n${inLanguage(date)}` : time;
  });
}

function compact(tick) {
  if (tick === null) return null; // a tick of a logarithmic axis without a label
  const size = Math.abs(tick);
  return typeset(size !== 0 && (size < 1e-3 || size >= 1e5) ? tick.toExponential(1) : String(Number(tick.toPrecision(6))));
}

function isDecade(tick) {
  return Math.abs(Math.log10(tick) - Math.round(Math.log10(tick))) < 1e-9;
}

/** Returns the label of a logarithmic axis: 0.01, 1, 10⁻⁶; none between the decades. */
export function power(tick) {
  if (tick === null || !isDecade(tick)) return null;
  const exponent = Math.round(Math.log10(tick));
  if (Math.abs(exponent) <= 2) return compact(tick);
  return powerOfTen(exponent);
}

function lastOf(data) {
  return data[0].length > 0 ? data[0].length - 1 : null;
}

/** Inserts an empty row into long gaps of the data, so that no line crosses them. */
function withHoles(data) {
  const times = data[0];
  if (times.length < 3) return data;
  const steps = [];
  for (let index = 1; index < times.length; index += 1) steps.push(times[index] - times[index - 1]);
  const usual = [...steps].sort((a, b) => a - b)[steps.length >> 1];
  const holes = steps.flatMap((step, index) => (step > HOLE_STEPS * usual && step > 1 ? [index + 1] : []));
  if (holes.length === 0) return data;
  return data.map((column, which) => {
    const out = column.slice();
    for (const hole of holes.toReversed()) out.splice(hole, 0, which === 0 ? times[hole - 1] + usual : null);
    return out;
  });
}
