// The plots of the year of a judged quantity.

import { dateOf, noon } from "./course.js";
import { fixed, t } from "./language.js";
import { Plot, css } from "./plot.js";
import { drawShape } from "./shapes.js";
import { AXES, number, typeset, unit, wordOf } from "./words.js";

/** Half-width of the 95 % interval of a Gaussian, in standard deviations. */
const HALF_95 = 1.96;
/** Size of the points (px). */
const SIZE = 2.6;
/** Heights of the plots (px). */
const TALL = 300;
const SQUARE = 400;
/** Share of the widest intervals that the axis leaves out, as after a first frost. */
const LEFT_OUT = 0.03;
/** Lowest ln of the evidence that the plot shows: less says nothing more. */
const LEAST_EVIDENCE = -3;
/**
 * Highest evidence that the plot shows, in thresholds. It grows for as long as a loss remains. What is above is
 * drawn here, below the top, and marked.
 */
const MOST_THRESHOLDS = 2.5;

/** How the days are drawn. Shapes distinguish them without colour. */
const KINDS = {
  learning: { name: t("measured-in-the-commissioning"), shape: "circle", colour: "--line-7", size: 1.7 },
  judged: { name: t("measured"), shape: "circle", colour: "--line-2" },
  outside: { name: t("outside-experience"), shape: "circle", isHollow: true, colour: "--line-2" },
  changed: { name: t("since-the-change"), shape: "diamond", colour: "--alarm" },
};

/** Seasons as months, because their names depend on the hemisphere. */
const SEASONS = [
  { name: t("dec-feb"), shape: "circle", colour: "--line-1", months: [12, 1, 2] },
  { name: t("mar-may"), shape: "triangle", colour: "--line-3", months: [3, 4, 5] },
  { name: t("jun-aug"), shape: "square", colour: "--line-6", months: [6, 7, 8] },
  { name: t("sep-nov"), shape: "falling", colour: "--line-4", months: [9, 10, 11] },
];

/** The ring around the newest day among days that are not sorted by time. */
const NEWEST = { name: t("newest-day"), shape: "ring", colour: "--ink", size: 6 };

const none = { paths: () => null, stroke: "transparent", width: 0 };
const edge = { stroke: "transparent", width: 0 };

/** Draws the points of some columns of a plot, each with its look. */
function paint(u, looks, first) {
  const { ctx, bbox, data } = u;
  const size = devicePixelRatio;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  looks.forEach((look, index) => {
    const colour = css(look.colour);
    data[first + index].forEach((value, row) => {
      if (value === null || value === undefined) return;
      drawShape(ctx, look, colour, u.valToPos(data[0][row], "x", true), u.valToPos(value, "y", true), (look.size ?? SIZE) * size);
    });
  });
  ctx.restore();
}

const kinds = Object.entries(KINDS);
/** Returns one column per kind of day, with the values of its days. */
const byKind = (rows, value) => kinds.map(([kind]) => rows.map((row) => (row.kind === kind ? value(row) : null)));
const legendOf = (looks) => looks.map(({ name, colour, shape, isHollow }) => ({ name, colour, shape, isHollow }));

const inUnit = ({ kind }) => (kind === "frequency" ? t("natural-frequency-hz") : AXES.ratio);

function quantile(values, share) {
  const sorted = values.filter((value) => value !== null && value !== undefined).sort((a, b) => a - b);
  return sorted.length > 0 ? sorted[Math.round(share * (sorted.length - 1))] : null;
}

/** Returns the mark of the day on which a change was found. */
function found(course) {
  const change = course?.rows.at(-1)?.change;
  return change ? [{ x: noon(change.found_ns), text: t("found", wordOf(change.kind)), colour: "--alarm" }] : [];
}

/** Returns the mark of the most probable first day of a change. */
function begun(course) {
  const change = course?.rows.at(-1)?.change;
  return change ? [{ x: noon(change.since_ns), text: t("probable-first-day"), colour: "--alarm" }] : [];
}

/** Returns the mark of the end of the commissioning. */
function learnt(course) {
  return course?.reference ? [{ x: noon(course.reference.to_ns), text: t("reference-learnt"), colour: "--learning" }] : [];
}

/** Returns the words of a day, without its date. */
function words(row) {
  if (!row || row.measured === null) return row?.sentence ?? t("no-data");
  const { expectation } = row;
  if (!expectation) return t("measured-no-reference-yet", number(row.measured));
  const { expected, interval } = expectation;
  const kind = row.kind === "outside" ? t("and-outside-experience") : row.kind === "changed" ? t("and-since-the-change") : "";
  return t("measured-expected", number(row.measured), number(expected), number(interval.low), number(interval.high), kind);
}

/** Returns the marks of what people have noted. */
function noted(course) {
  const mark = ({ from_ns: from, kind, effect }) => ({ x: from / 1e9, text: `${effect === "new-reference" ? t("mark-new-reference") : `✎ ${wordOf(kind)}`}`, colour: "--notice" });
  return (course?.annotations ?? []).map(mark);
}

/** Settings that all plots over the days share. */
function overDays(points, plot) {
  const at = (data, index) => points.course?.byTime.get(data[0][index]);
  return { names: ["course"], sync: "days", at: dateOf, ...plot, readout: (data, index) => plot.readout(at(data, index)) };
}

/** Creates the plot of the measured and the expected values. */
export function valuePlot(points, span) {
  const plot = overDays(points, {
    title: t("measured-and-expected"),
    file: "year",
    height: TALL,
    legend: [...legendOf(Object.values(KINDS)), { name: t("expected"), colour: "--line-1", dash: [] }, { name: t("95-per-cent-interval-of-a-day"), colour: "--band-95" }],
    unit: () => inUnit(points.course ?? {}),
    rows: (columns) => {
      const { rows } = columns.get("course");
      const of = (value) => rows.map((row) => (row.expectation ? value(row.expectation) : null));
      return [rows.map(({ time }) => time), of(({ interval }) => interval.low), of(({ interval }) => interval.high), of(({ expected }) => expected), ...byKind(rows, (row) => row.measured)];
    },
    series: () => [edge, edge, { stroke: () => css("--line-1"), width: 1.5 }, ...kinds.map(() => none)],
    bands: () => [{ series: [2, 1], fill: css("--band-95") }],
    range: (u) => {
      const { min, max } = span.shown;
      const seen = (column) => u.data[column].filter((value, row) => value !== null && u.data[0][row] >= min && u.data[0][row] <= max);
      const ends = [quantile(seen(1), LEFT_OUT), quantile(seen(2), 1 - LEFT_OUT), ...kinds.flatMap((_, index) => seen(4 + index))].filter((end) => end !== null);
      if (ends.length === 0) return [0, 1];
      const [low, high] = [Math.min(...ends), Math.max(...ends)];
      const room = Math.max(0.06 * (high - low), 1e-9 * Math.abs(high));
      return [low - room, high + room];
    },
    paint: (u) => paint(u, Object.values(KINDS), 4),
    marks: () => [found, begun, learnt, noted].flatMap((of) => of(points.course)),
    readout: words,
  });
  return new Plot(plot, points, span);
}

/** Creates the plot of the residuals, in standard deviations. */
export function residualPlot(points, span) {
  const plot = overDays(points, {
    title: t("residuals"),
    file: "residuals",
    unit: t("standard-deviations"),
    rows: (columns) => {
      const { rows } = columns.get("course");
      return [rows.map(({ time }) => time), ...byKind(rows, ({ expectation }) => expectation?.residual ?? null)];
    },
    series: () => kinds.map(() => none),
    range: (_, least, largest) => [Math.min(-3, 1.08 * (least ?? 0)), Math.max(3, 1.08 * (largest ?? 0))],
    paint: (u) => paint(u, Object.values(KINDS), 1),
    marks: () => [...begun(points.course), { y: 0, text: "", isSolid: true }, { y: HALF_95, text: "" }, { y: -HALF_95, text: t("95-per-cent-of-sound-days"), isBelow: true }],
    readout: (row) => (row?.expectation ? t("residual", typeset(row.expectation.residual.toFixed(2))) : words(row)),
  });
  return new Plot(plot, points, span);
}

/** Returns the evidence of a day in words. A drift far above its threshold needs no decimals. */
function evidenceWords({ ln_evidence: evidence, ln_threshold: threshold, cusum_share: share }) {
  const ln = (value) => typeset(value.toFixed(Math.abs(value) < 100 ? 1 : 0));
  return t("evidence-of-cusum-at", ln(evidence), ln(threshold), fixed(share, share < 10 ? 1 : 0));
}

/** Creates the plot of the evidence of a loss and its threshold. */
export function evidencePlot(points, span) {
  const last = () => points.course?.rows.findLast(({ expectation }) => expectation)?.expectation;
  const most = () => MOST_THRESHOLDS * (last()?.ln_threshold ?? 1);
  /** Returns the mark of the values above the axis, if the plot shows any. */
  const above = () => {
    const { min, max } = span.shown;
    const isCut = ({ time, expectation }) => expectation?.ln_evidence > most() && time >= min && time <= max;
    return points.course?.rows.some(isCut) ? [{ y: most(), text: t("above-the-axis"), isBelow: true }] : [];
  };
  const plot = overDays(points, {
    title: t("evidence-of-a-loss"),
    file: "evidence",
    unit: t("ln-of-the-evidence"),
    rows: (columns) => {
      const { rows } = columns.get("course");
      return [rows.map(({ time }) => time), rows.map(({ expectation }) => (expectation ? Math.min(Math.max(expectation.ln_evidence, LEAST_EVIDENCE), most()) : null))];
    },
    series: () => [{ stroke: () => css("--line-1"), width: 2, fill: () => css("--band-997"), fillTo: () => LEAST_EVIDENCE }],
    range: (_, __, largest) => {
      const threshold = last()?.ln_threshold ?? 1;
      return [LEAST_EVIDENCE, Math.max(1.15 * threshold, 1.1 * (largest ?? 0))];
    },
    marks: () => [...found(points.course), ...above(), ...(last() ? [{ y: last().ln_threshold, text: t("threshold"), colour: "--alarm" }] : [])],
    readout: (row) => (row?.expectation ? evidenceWords(row.expectation) : words(row)),
  });
  return new Plot(plot, points, span);
}

/** The range of a plot that is not over time: all values, or a part chosen by the user. */
export class Extent {
  #fixed = null;
  #listeners = [];
  all = [0, 1];
  length_s = null;

  get shown() {
    const [min, max] = this.#fixed ?? this.all;
    return { min, max };
  }

  live() {
    this.#set(null);
  }

  fix(from, to) {
    this.#set([from, to]);
  }

  onchange(listener) {
    this.#listeners.push(listener);
  }

  #set(fixed) {
    this.#fixed = fixed;
    this.#listeners.forEach((listener) => listener());
  }
}

/** Returns a condition with its unit: deck (°C). */
export function conditionTitle({ name, unit: of }) {
  return of ? `${name} (${unit(of)})` : name;
}

/** Creates the plot of the values over the first condition, with a look for each season. */
export function conditionScatter(points, span, extent) {
  const condition = () => points.course?.conditions[0];
  // As in the other plots, a hollow shape is a day outside experience, and a diamond is one since the change.
  const looks = [...SEASONS, ...SEASONS.map((season) => ({ ...season, isHollow: true })), KINDS.changed];
  const drawn = [...looks, NEWEST];
  const season = (row) => SEASONS.findIndex(({ months }) => months.includes(1 + new Date(1000 * row.time).getUTCMonth()));
  const place = (row) => (row.kind === "changed" ? looks.length - 1 : season(row) + (row.kind === "outside" ? SEASONS.length : 0));
  const plot = {
    title: t("measured-values-over-the-first-condition"),
    file: "scatter",
    height: SQUARE,
    names: ["course"],
    legend: legendOf([...SEASONS, { ...KINDS.outside, colour: "--ink-soft" }, KINDS.changed, NEWEST]),
    across: () => (condition() ? conditionTitle(condition()) : ""),
    unit: () => inUnit(points.course ?? {}),
    rows: (columns) => {
      const { from_s, to_s } = span;
      const rows = columns.get("course").rows.filter(({ measured, conditions, time }) => measured !== null && conditions.length > 0 && time >= from_s && time <= to_s);
      rows.sort((a, b) => a.conditions[0] - b.conditions[0]);
      const values = rows.map(({ conditions }) => conditions[0]);
      const room = values.length > 0 ? Math.max(0.03 * (values.at(-1) - values[0]), 1e-6) : 0;
      if (values.length > 0) extent.all = [values[0] - room, values.at(-1) + room];
      const of = (index) => rows.map((row) => (place(row) === index ? row.measured : null));
      const times = rows.map(({ time }) => time);
      const newest = Math.max(...times);
      return [values, ...looks.map((_, index) => of(index)), rows.map(({ time, measured }) => (time === newest ? measured : null)), times];
    },
    series: () => [...drawn.map(() => none), { show: false }],
    // The rows are sorted by the condition.
    newest: (data) => data.at(-1).indexOf(Math.max(...data.at(-1))),
    paint: (u) => paint(u, drawn.map((look) => ({ size: 3, ...look })), 1),
    readout: (data, index) => {
      const row = points.course?.byTime.get(data.at(-1)[index]);
      return row ? `${dateOf(row.time)} · ${number(row.conditions[0])}${condition()?.unit ? ` ${unit(condition().unit)}` : ""} · ${words(row)}` : "";
    },
  };
  return new Plot(plot, points, extent);
}
