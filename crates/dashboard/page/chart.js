// A plot of a report, as a drawing that stays sharp in print: mean with its 95 % interval, threshold
// and marks.

import { s } from "./dom.js";
import { fixed } from "./language.js";
import { flags } from "./marks.js";
import { HOLE_STEPS, timeTicks } from "./plot.js";

/** Size of the drawing, and room around the plotted area, in its own units. */
const [WIDTH, HEIGHT] = [360, 150];
/** Width of a drawing that fills a row of two. */
export const WIDE = 735;
const ROOM = { left: 44, right: 8, bottom: 30, top: 8 };
/** Height of a row of labels, and width of a character, above the plotted area. */
const [ROW, CHARACTER] = [11, 5.2];
/** Distance of the words of a threshold below its line. Above it are the estimates of sound parts. */
const BOUND_BELOW = 10;
/** Half-width of the 95 % interval of a Gaussian, in standard deviations. */
const HALF_95 = 1.96;
/** Share of the widest intervals, as at the start, that a scale leaves out. */
const LEFT_OUT = 0.05;
/** Possible steps of the times (s), and maximum number of times. */
const STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400, 2 * 86400, 7 * 86400, 14 * 86400, 30 * 86400, 90 * 86400, 365 * 86400];
const [MOST_TIMES, MOST_TIMES_WIDE] = [5, 10];

/** Returns the range of values of a series that a plot needs, or null without data. */
export function rangeOf([, means, stds], more = []) {
  const rows = means.map((_, row) => row).filter((row) => means[row] !== null);
  if (rows.length === 0) return null;
  const ends = (sign) => rows.map((row) => means[row] + sign * HALF_95 * (stds[row] ?? 0)).sort((a, b) => a - b);
  const at = Math.round(LEFT_OUT * (rows.length - 1));
  const all = [ends(-1)[at], ends(1).at(-1 - at), means[rows.at(-1)], ...more];
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const room = Math.max(0.06 * (high - low), 1e-4 * Math.abs(high), 1e-12);
  return [low - room, high + room];
}

/** Returns round values within a range, at most about five. */
function roundValues([low, high]) {
  const rough = (high - low) / 4;
  const decade = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * decade).find((step) => step >= rough);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.max(0, Math.floor(high / step) - first + 1) }, (_, index) => ({ value: (first + index) * step, text: fixed((first + index) * step, digits) }));
}

function roundTimes(from_s, to_s, most) {
  const step = STEPS_S.find((step) => (to_s - from_s) / step <= most) ?? STEPS_S.at(-1);
  const first = Math.ceil(from_s / step);
  const times = Array.from({ length: Math.max(0, Math.floor(to_s / step) - first + 1) }, (_, index) => (first + index) * step);
  return { times, texts: timeTicks(times, step) };
}

/**
 * Draws a series of times, means and standard deviations.
 *
 * `marks` are moments { x, text, colour }. `bound` { y, text } is a threshold. `hasPoints` shows each
 * value as a point. `dots` are further values of these times, shown as points. `width` is that of the drawing, in its own units.
 */
export function chart({ columns, from_s, to_s, range, label, marks = [], bound = null, hasPoints = false, dots = [], width = WIDTH }) {
  const [times, means, stds] = columns;
  const inside = width - ROOM.left - ROOM.right;
  const told = flags(marks, { min: from_s, max: to_s }, inside, (text) => CHARACTER * text.length);
  const top = ROOM.top + ROW * told.reduce((most, { row }) => Math.max(most, row + 1), 0);
  const bottom = HEIGHT - ROOM.bottom;
  const x = (time) => ROOM.left + ((time - from_s) / (to_s - from_s)) * inside;
  const y = (value) => Math.min(Math.max(bottom - ((value - range[0]) / (range[1] - range[0])) * (bottom - top), top), bottom);
  const point = (time, value) => `${x(time).toFixed(1)} ${y(value).toFixed(1)}`;
  const dot = (time, value) => s("circle", { class: "dot", cx: x(time), cy: y(value), r: 1.6 });
  /** Returns the end of the threshold for its words: the left one, unless only the right one is free of the curve. */
  const boundPlace = () => {
    const wide = CHARACTER * bound.text.length + 6;
    const isCrossed = (from, to) => {
      const heights = times.flatMap((time, row) => (means[row] !== null && x(time) >= from && x(time) <= to ? [y(means[row])] : []));
      return Math.min(...heights) < y(bound.y) + BOUND_BELOW + 3 && Math.max(...heights) > y(bound.y);
    };
    const end = width - ROOM.right;
    return isCrossed(ROOM.left, ROOM.left + wide) && !isCrossed(end - wide, end) ? { x: end - 3, "text-anchor": "end" } : { x: ROOM.left + 3 };
  };
  /** Returns the height of these words: below the line, unless they would cross the axis. */
  const boundHeight = () => (y(bound.y) + BOUND_BELOW > bottom - 2 ? y(bound.y) - 3 : y(bound.y) + BOUND_BELOW);
  const svg = s("svg", { class: "chart", viewBox: `0 0 ${width} ${HEIGHT}`, role: "img", "aria-label": label });
  for (const { value, text } of roundValues(range)) {
    svg.append(s("line", { class: "grid", x1: ROOM.left, x2: width - ROOM.right, y1: y(value), y2: y(value) }), s("text", { class: "value", x: ROOM.left - 4, y: y(value) + 3 }, text));
  }
  const { times: ticks, texts } = roundTimes(from_s, to_s, width > WIDTH ? MOST_TIMES_WIDE : MOST_TIMES);
  ticks.forEach((time, index) => {
    svg.append(s("line", { class: "grid", x1: x(time), x2: x(time), y1: top, y2: bottom }));
    String(texts[index]).split("\n").forEach((text, row) => svg.append(s("text", { class: "time", x: Math.min(x(time), width - (CHARACTER * text.length) / 2), y: bottom + 12 + 11 * row }, text)));
  });
  for (const rows of pieces(times, means)) {
    if (!hasPoints || rows.length > 1) {
      const upper = rows.map((row) => point(times[row], means[row] + HALF_95 * (stds[row] ?? 0)));
      const lower = rows.map((row) => point(times[row], means[row] - HALF_95 * (stds[row] ?? 0)));
      svg.append(s("path", { class: "band", d: `M${[...upper, ...lower.toReversed()].join("L")}Z` }), s("path", { class: "line", d: `M${rows.map((row) => point(times[row], means[row])).join("L")}` }));
    }
    if (hasPoints) rows.forEach((row) => svg.append(dot(times[row], means[row])));
  }
  dots.forEach((value, row) => value !== null && svg.append(dot(times[row], value)));
  if (bound && bound.y > range[0] && bound.y < range[1]) svg.append(s("line", { class: "bound", x1: ROOM.left, x2: width - ROOM.right, y1: y(bound.y), y2: y(bound.y) }), s("text", { class: "bound-text", ...boundPlace(), y: boundHeight() }, bound.text));
  for (const { at, row, text, from, colour } of told) {
    const line = s("line", { class: "moment", x1: ROOM.left + at, x2: ROOM.left + at, y1: row < 0 ? top : top - (row + 1) * ROW + 2, y2: bottom });
    line.style.stroke = `var(${colour})`;
    svg.append(line);
    if (row < 0) continue;
    const word = s("text", { class: "moment-text", x: ROOM.left + from, y: top - row * ROW - 3 }, text);
    word.style.fill = `var(${colour})`;
    svg.append(word);
  }
  svg.append(s("line", { class: "axis", x1: ROOM.left, x2: width - ROOM.right, y1: bottom, y2: bottom }));
  return svg;
}

/** Returns the rows with values, in pieces without long gaps. */
export function pieces(times, means) {
  const rows = times.map((_, row) => row).filter((row) => means[row] !== null);
  const steps = rows.slice(1).map((row, index) => times[row] - times[rows[index]]);
  const usual = steps.toSorted((a, b) => a - b)[steps.length >> 1] ?? 0;
  const found = [];
  rows.forEach((row, index) => {
    if (index === 0 || steps[index - 1] > HOLE_STEPS * usual) found.push([]);
    found.at(-1).push(row);
  });
  return found;
}
