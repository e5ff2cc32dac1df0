// The days of a judged quantity, as the plots of its year need them.

import { inLanguage } from "./language.js";

/** Seconds from the start of a day to the time at which the plots show it. */
const NOON_S = 43200;

/** Returns the date of a day of the course (UTC, because a day of the judgement is one of UTC). */
export function dateOf(seconds) {
  return inLanguage(new Date(1000 * seconds).toISOString().slice(0, 10));
}

/** Returns the time at which the plots show a day (s). */
export function noon(day_ns) {
  return day_ns / 1e9 + NOON_S;
}

/** Fetches the course of one quantity in the span of its plots. */
export class CoursePoints {
  #answer = null;
  #asked = null;
  /** What prevents an answer, in words. */
  trouble = null;

  constructor(structure, span) {
    Object.assign(this, { structure, span, quantity: null });
  }

  /** The last answer for the quantity, or null. */
  get course() {
    return this.#answer?.quantity === this.quantity ? this.#answer : null;
  }

  /** All plots show the same days. Returns null before they have arrived. */
  columns() {
    return this.course;
  }

  csv() {
    return `${this.#address()}&format=csv`;
  }

  /** Forgets the answer, so that the next plot fetches it again. */
  forget() {
    this.#asked = null;
  }

  /** Fetches the days once for all plots. Returns whether they have arrived. */
  fetch() {
    const address = this.#address();
    if (this.#asked?.address !== address) this.#asked = { address, answer: this.#fetch(address, this.quantity) };
    return this.#asked.answer;
  }

  async #fetch(address, quantity) {
    const response = await fetch(address);
    const answer = await response.json();
    if (quantity !== this.quantity) return false;
    this.trouble = response.ok ? null : answer.error;
    if (!response.ok) {
      this.forget();
      return false;
    }
    this.#answer = { ...prepared(answer), quantity };
    if (answer.kept_from_ns !== null) this.span.keptFrom_s = noon(answer.kept_from_ns);
    return true;
  }

  #address() {
    const query = new URLSearchParams();
    const { isLive, newest_s, from_s, to_s } = this.span;
    if (!isLive || newest_s !== null) query.set("from", from_s);
    if (!isLive) query.set("to", to_s);
    const [structure, quantity] = [this.structure, this.quantity ?? ""].map(encodeURIComponent);
    return `/api/structures/${structure}/judgements/${quantity}/course?${query}`;
  }
}

/** Returns an answer with its rows by time and their kinds. */
function prepared(answer) {
  const change = answer.rows.at(-1)?.change ?? null;
  const rows = answer.rows.map((row) => ({ ...row, time: noon(row.day_ns), kind: kindOf(row, change) }));
  return { ...answer, rows, byTime: new Map(rows.map((row) => [row.time, row])) };
}

/**
 * Returns how a day is drawn: learning, outside, changed (since the most probable first day of the
 * present change), judged, or null without a value.
 */
function kindOf(row, change) {
  if (row.measured === null) return null;
  if (!row.expectation) return "learning";
  if (row.state === "outside-experience") return "outside";
  return change !== null && row.day_ns >= change.since_ns ? "changed" : "judged";
}
