// The last day of the worst part of each structure, as small lines on the cards. Only visible cards
// fetch it.

import { fixed, t } from "./language.js";
import { cleared, css } from "./plot.js";
import { DAY_S } from "./span.js";

/** Number of points of a line, about one in a quarter of an hour. */
const POINTS = 96;
/** Interval after which a line is fetched again (ms). */
const REFRESH_MS = 300_000;
/** Interval after which a line is fetched again if the history did not supply all of it (ms). */
const RETRY_MS = 30_000;
/** Smallest span of values that fills the height, as a ratio to the design. */
const LEAST_SPAN = 0.05;
/** Length of the data below which a line is not shown (s). It would be a vertical stroke or a dot. */
const LEAST_S = DAY_S / 20;
/** Radius of the dot at the newest value (px). */
const DOT = 2;

export class Sparklines {
  constructor() {
    this.lines = new Map();
    // A hidden canvas is never in the window, but its card is.
    this.seen = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => (this.lines.get(target).isSeen = isIntersecting)));
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.recolour = () => this.lines.forEach(({ redraw }) => redraw?.());
    this.scheme.addEventListener("change", this.recolour);
  }

  close() {
    this.seen.disconnect();
    this.scheme.removeEventListener("change", this.recolour);
  }

  /** Prepares the line of a structure on a card. */
  watch(canvas, structure) {
    const card = canvas.closest("li");
    this.lines.set(card, { structure, parameter: null, at: -Infinity, isSeen: false });
    this.seen.observe(card);
  }

  /** Shows the line of the worst part, and fetches it if it is old. */
  show(canvas, { worst, time_s }) {
    const line = this.lines.get(canvas.closest("li"));
    const isOld = performance.now() - line.at > REFRESH_MS || line.parameter !== worst?.parameter;
    if (!worst || time_s === null || !line.isSeen || !isOld || document.hidden) return;
    Object.assign(line, { parameter: worst.parameter, at: performance.now() });
    this.#fetch(canvas, line, { from_s: time_s - DAY_S, to_s: time_s }).catch(() => (line.at = -Infinity));
  }

  async #fetch(canvas, line, { from_s, to_s }) {
    const { structure, parameter } = line;
    const query = new URLSearchParams({ series: `parameter/${parameter}`, points: POINTS, from: from_s });
    const response = await fetch(`/api/structures/${encodeURIComponent(structure)}/history?${query}`);
    if (!response.ok) return;
    const { series, incomplete } = await response.json();
    if (incomplete) line.at = performance.now() - REFRESH_MS + RETRY_MS;
    const [times, means] = series[0]?.data ?? [[], []];
    const rows = times.map((_, row) => row).filter((row) => means[row] !== null);
    canvas.hidden = rows.length < 2 || times[rows.at(-1)] - times[rows[0]] < LEAST_S;
    if (canvas.hidden) return;
    const values = rows.map((row) => means[row]);
    canvas.setAttribute("aria-label", t("over-the-last-day-from-to-of", parameter, fixed(Math.min(...values), 3), fixed(Math.max(...values), 3)));
    canvas.title = canvas.getAttribute("aria-label");
    const shares = rows.map((row) => (times[row] - from_s) / (to_s - from_s));
    line.redraw = () => draw(canvas, shares, values);
    line.redraw();
  }
}

/** Draws values at their shares of the day. A dot marks the newest one. */
function draw(canvas, shares, values) {
  const { ctx, width, height } = cleared(canvas);
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const room = Math.max(0, LEAST_SPAN - (high - low)) / 2;
  [ctx.strokeStyle, ctx.lineWidth, ctx.lineJoin] = [css("--line-1"), 1.5, "round"];
  ctx.beginPath();
  const x = (index) => 1 + Math.min(shares[index], 1) * (width - 2 - DOT);
  const y = (index) => height - 1 - DOT - ((values[index] - low + room) / (high - low + 2 * room)) * (height - 2 - 2 * DOT);
  shares.forEach((_, index) => ctx.lineTo(x(index), y(index)));
  ctx.stroke();
  ctx.beginPath();
  ctx.arc(x(shares.length - 1), y(shares.length - 1), DOT, 0, 2 * Math.PI);
  ctx.fillStyle = css("--line-1");
  ctx.fill();
}
