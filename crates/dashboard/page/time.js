// Times: the zone in which the page shows them, and all of their formats.

import { unbroken, whole } from "./dom.js";
import { SERVICES, fixed, inLanguage, t } from "./language.js";

/** Key of the chosen zone in local storage. */
const ZONE_KEY = "spandrel-zone";
/**
 * Times below this limit belong to a record that starts at 0. It is three years, longer than any
 * record.
 */
const WITHOUT_DATES_BEFORE_S = 1e8;
/** A date, or a date with a time and a zone, in a sentence of a service or of the page. No part of a name is one. */
const STAMP = /(?<![\p{L}\d_./-])(?:\d{4}-\d\d-\d\d|\d\d\.\d\d\.\d{4})(?![\p{L}\d_-])(?: \d\d:\d\d:\d\d UTC(?:[+−]\d+(?::\d\d)?)?)?/gu;

let local = localStorage.getItem(ZONE_KEY) === "local";

/** Returns whether times are shown in the zone of the browser instead of UTC. */
export function isLocal() {
  return local;
}

/** Selects the zone of the browser, or UTC, for this browser. */
export function showLocal(isWanted) {
  local = isWanted;
  localStorage.setItem(ZONE_KEY, isWanted ? "local" : "utc");
}

/** Returns whether a time belongs to a record that starts at 0. */
export function isWithoutDate(seconds) {
  return Math.abs(seconds) < WITHOUT_DATES_BEFORE_S;
}

/** Returns the distance of the shown zone from UTC at a time (min). */
function shift_min(seconds) {
  return local ? -new Date(1000 * seconds).getTimezoneOffset() : 0;
}

/** Returns the name of the shown zone at a time: UTC, UTC+1 or UTC+5:30. */
export function zone(seconds) {
  const shift = shift_min(seconds);
  const [hours, minutes] = [Math.floor(Math.abs(shift) / 60), Math.abs(shift) % 60];
  if (shift === 0) return "UTC";
  return `UTC${shift < 0 ? "−" : "+"}${hours}${minutes ? `:${String(minutes).padStart(2, "0")}` : ""}`;
}

/** Returns the date and the time of day, to the millisecond, in the shown zone. */
export function moment(seconds) {
  const text = new Date(1000 * (seconds + 60 * shift_min(seconds))).toISOString();
  return { date: text.slice(0, -14), clock: text.slice(-13, -1) };
}

/** Formats a measurement time, or the time in a record without dates. */
export function time(seconds) {
  if (isWithoutDate(seconds)) return `${fixed(seconds, 2)} s`;
  return written(seconds, inLanguage(moment(seconds).date));
}

function written(seconds, date) {
  return `${date} ${moment(seconds).clock.slice(0, 8)} ${zone(seconds)}`;
}

/** Formats the time of day only, or the time in a record without dates. */
export function clock(seconds) {
  if (isWithoutDate(seconds)) return time(seconds);
  return `${inLanguage(moment(seconds).clock.slice(0, 10))} ${zone(seconds)}`;
}

/** Formats a time in a record without dates in hours, minutes and seconds: 0:01:30. */
export function recordTime(seconds, digits = 0) {
  const unit = 10 ** digits;
  const size = Math.round(Math.abs(seconds) * unit) / unit;
  const [hours, minutes] = [Math.floor(size / 3600), Math.floor(size / 60) % 60];
  const rest = fixed(size % 60, digits).padStart(digits ? 3 + digits : 2, "0");
  return `${seconds < 0 && size > 0 ? "−" : ""}${hours}:${String(minutes).padStart(2, "0")}:${rest}`;
}

/** A time in a field: the date as ISO 8601 or as in German, the time of day, and the zone. The last two can be left out. */
const FIELD = /^(?:(\d{4}-\d\d-\d\d)|(\d\d)\.(\d\d)\.(\d{4}))(?:[T ](\d\d:\d\d(?::\d\d(?:\.\d+)?)?))?(?: ?(UTC|Z))?$/;

/** Formats a time for a field of a form. */
export function fieldOf(seconds) {
  const { date, clock: of } = moment(seconds);
  return `${inLanguage(date)} ${of.slice(0, 8)}`;
}

/**
 * Returns the time in a field of a form (s since 1970), or NaN without one. It is in the shown zone, or in
 * UTC if it says so, as a pasted time does.
 */
export function timeOfField(text) {
  const [, iso, day, month, year, of = "00:00", utc] = FIELD.exec(text.trim()) ?? [];
  const date = iso ?? `${year}-${month}-${day}`;
  // Some browsers take 31 February for 3 March.
  if (new Date(`${date}T00:00Z`).toJSON()?.slice(0, 10) !== date) return NaN;
  return Date.parse(`${date}T${of}${local && !utc ? "" : "Z"}`) / 1000;
}

/** Makes a field take a time as text. The browser's own field has another format, and no time can be pasted. */
export function asTimeField(input) {
  const format = t("format-of-a-time");
  return Object.assign(input, { type: "text", pattern: FIELD.source.slice(1, -1), title: format, placeholder: format, autocomplete: "off" });
}

/** Formats a duration in words. */
export function duration(seconds) {
  const size = Math.abs(seconds);
  if (size < 1) return `${fixed(size, 1)} s`;
  if (size < 120) return `${Math.round(size)} s`;
  if (size < 7200) return `${Math.round(size / 60)} min`;
  if (size < 48 * 3600) return `${Math.round(size / 3600)} h`;
  return t("days", Math.round(size / 86400));
}

/**
 * A small letter at the start of a sentence. The first word is a name if a verb or a colon follows it, or
 * if it contains a digit or a hyphen. A pronoun is no name.
 */
const SMALL_LETTER = /^(?:(?=(?:it|all|none|nothing|nobody|this|there)\b)|(?!\p{Ll}+(?:[-\d._/:\p{Lu}]| (?:is|has|had|lost|gained|seems|was)\b)))\p{Ll}/u;

/**
 * Returns a sentence of a service with a capital letter at its start. Services write a small letter,
 * because they join sentences. Names stay as they are.
 */
export function capitalised(text) {
  return text.replace(SMALL_LETTER, (letter) => letter.toUpperCase());
}

/**
 * Shows a sentence with its times in the shown zone and in the format of the page. The server writes
 * times in UTC, as ISO 8601. No time and no short name breaks at the end of a line. A sentence of a
 * service starts with a capital letter.
 */
export function setSentence(element, sentence) {
  const text = element.lang === SERVICES ? capitalised(sentence) : sentence;
  const told = `${local} ${text}`;
  if (element.told === told) return;
  element.told = told;
  const pieces = [];
  let end = 0;
  for (const { 0: stamp, index } of text.matchAll(STAMP)) {
    const seconds = Date.parse(stamp.replace(" ", "T").replace(" UTC", "Z")) / 1000;
    // A date in the format of the page is already in its zone. Some browsers read it with the month first.
    const isKnown = Number.isFinite(seconds) && /^\d{4}-/.test(stamp);
    const shown = !isKnown ? stamp : stamp.endsWith("UTC") ? written(seconds, inLanguage(moment(seconds).date)) : inLanguage(stamp);
    pieces.push(...unbroken(withMinus(text.slice(end, index))), whole(shown));
    end = index + stamp.length;
  }
  element.replaceChildren(...pieces, ...unbroken(withMinus(text.slice(end))));
}

/** Returns a text with a minus sign before negative numbers. Names with hyphens stay as they are. */
export function withMinus(text) {
  return text.replaceAll(/(?<![\p{L}\d_.-])-(?=\d)/gu, "−");
}
