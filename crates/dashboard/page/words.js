// Names of states and formats of numbers. The formats of times and addresses are beside it.

import { dateOf } from "./course.js";
import { fixed, inLanguage, t, wordOf } from "./language.js";
import { duration, time } from "./time.js";

export * from "./address.js";
export { SERVICES, wordOf } from "./language.js";
export * from "./time.js";

/** Silence after which data are not of the present (s). The server has the same limit. */
const STALE_S = 3;

/** Names and signs of the levels of attention. Sign and word distinguish them without colour. */
export const LEVELS = {
  alarm: { sign: "▲", word: t("level-alarm") },
  stale: { sign: "✕", word: t("level-stale") },
  warning: { sign: "◆", word: t("warning") },
  notice: { sign: "●", word: t("level-notice") },
  undecided: { sign: "?", word: t("level-undecided") },
  learning: { sign: "…", word: t("level-learning") },
  normal: { sign: "✓", word: t("level-normal") },
};

/**
 * Returns sign and word of the level of a structure. An active loss that somebody handles is more than a
 * notice, and has its own word.
 */
export function attentionWords({ level, acknowledged }) {
  const { sign, word } = LEVELS[level];
  return { sign, word: level === "notice" && acknowledged > 0 ? t("level-acknowledged") : word };
}

/** Names of the tabs of a structure, and the texts above their contents. */
export const TABS = { now: t("now"), parameters: t("parameters"), compare: t("compare"), lasting: t("lasting-change"), model: t("model"), sensors: t("sensors"), events: t("events"), settings: t("settings") };

/** Titles of the columns of the tables. */
export const COLUMNS = {
  parts: [t("part"), t("state"), t("estimate"), t("95-per-cent-interval"), t("probability-of-loss")],
  sensors: [t("sensor"), t("quantity"), t("node"), t("state"), t("last-sample-used"), t("compared-with-the-others"), t("probability-of-a-fault"), t("sampling-instant"), t("clock"), t("rejected")],
  differences: [t("quantity"), t("first-mean"), t("second-mean"), t("difference"), t("95-per-cent-interval"), t("result")],
  levels: [t("sensor"), t("state"), t("samples-per-second"), t("mean"), t("rms"), t("peak"), t("last-sample")],
  modes: [t("mode"), t("state"), t("frequency"), t("95-per-cent-interval"), t("damping-ratio"), t("epoch-until"), t("found-in-the-last-epochs")],
  events: [t("time"), t("about"), t("what-happened"), ""],
  services: [t("service"), t("state"), t("lag"), t("items-processed"), t("dropped-or-corrected")],
  delays: [t("loss-of-stiffness"), t("found-after-median"), t("found-within-30-days")],
  rules: [t("parameters"), t("loss"), t("probability-required"), t("duration-required"), t("reference")],
};

/** Explanations of column titles. */
export const HINTS = { [t("epoch-until")]: t("hint-epoch"), [t("sampling-instant")]: t("hint-sampling-instant"), [t("compared-with-the-others")]: t("hint-compared") };

/** Titles of the axes. All of these quantities have no unit. */
export const AXES = {
  ratio: t("value-design-value"),
  plausibility: t("plausibility"),
  distance: t("distance-from-the-others"),
  consistency: t("per-channel"),
  damping: t("noise-level-psi"),
};

/** Words for a parameter without a state. */
export const NO_RULE = t("no-alert-rule");

/** Returns the state of a part of a structure without a filter. */
export function notJudged({ judged }) {
  return judged.length > 0 ? t("not-judged-within-seconds") : t("not-judged-now");
}
export const NOT_STIFFNESS = t("not-a-stiffness");

/** Number of parts or structures above which a search field is shown. */
export const SEARCH_ABOVE = 12;

const collator = new Intl.Collator("en", { numeric: true });

/** Compares names in their natural order: `storey-2` is before `storey-10`. */
export function natural(a, b) {
  return collator.compare(a, b);
}

/** Names, signs and levels of the states of an alert. */
export const STATES = {
  raised: { sign: "▲", word: t("raised"), level: "alarm" },
  unconfirmed: { sign: "△", word: t("unconfirmed"), level: "alarm" },
  pending: { sign: "◆", word: t("pending"), level: "warning" },
  "softening-in-motion": { sign: "≈", word: t("softening-in-motion"), level: "notice" },
  acknowledged: { sign: "●", word: t("state-acknowledged"), level: "notice" },
  cleared: { sign: "○", word: t("cleared"), level: "notice" },
  undecided: { sign: "?", word: t("state-undecided"), level: "learning" },
  learning: { sign: "…", word: t("state-learning"), level: "learning" },
  normal: { sign: "✓", word: t("state-normal"), level: "normal" },
};

/** States of alerts that need attention, and that a report lists one by one. The others change often. */
export const LISTED = ["raised", "unconfirmed", "pending", "acknowledged", "cleared"];

/** Words of a report for how soon an inspector is needed, the most urgent first, with their levels. */
export const URGENCIES = { "inspect first": "alarm", inspect: "warning", watch: "notice", "no action": "normal" };

/** Signs and levels of the verdicts on the fit. */
export const FITS = {
  supported: { sign: "✓", level: "normal" },
  doubtful: { sign: "◆", level: "learning" },
  contradicted: { sign: "✕", level: "warning" },
};

/** Names, signs and levels of the health of sensors. */
export const HEALTH = {
  alive: { sign: "●", word: t("delivers"), level: "normal" },
  gone: { sign: "✕", word: t("state-gone"), level: "warning" },
  silent: { sign: "✕", word: t("silent"), level: "warning" },
  "wrong-clock": { sign: "✕", word: t("wrong-clock-not-used"), level: "warning" },
  "in-doubt": { sign: "▲", word: t("in-doubt"), level: "warning" },
  faulty: { sign: "▲", word: t("faulty-not-used"), level: "warning" },
  excluded: { sign: "◆", word: t("excluded-disagrees-with-the-others"), level: "warning" },
  ended: { sign: "■", word: t("record-has-ended"), level: "learning" },
  "no-sample": { sign: "✕", word: t("no-sample-since-the-server-started"), level: "warning" },
  unknown: { sign: "○", word: wordOf("unknown"), level: "learning" },
};

/** Names, signs and levels of the states of distributed nodes. */
export const NODES = {
  used: { sign: "●", word: t("node-alive"), level: "normal" },
  silent: { sign: "○", word: t("silent"), level: "warning" },
  excluded: { sign: "◆", word: t("excluded-disagrees-with-the-others"), level: "warning" },
  ended: { sign: "■", word: t("ended"), level: "learning" },
};

/** Returns the level of an alert. An acknowledged alert is not an alarm. */
function levelOf(alert) {
  return alert.state === "unconfirmed" && alert.acknowledged_by ? "notice" : STATES[alert.state].level;
}

/** Sign and word of a part of which the present data say nothing. */
export const BLIND = { sign: "◌", word: wordOf("blind") };

/** Returns sign, word and level of a parameter: normal only if damage would be noticed. */
export function stateOf(alert) {
  const { sign, word } = STATES[alert.state];
  if (alert.state === "normal" && alert.unwatched) return { sign: BLIND.sign, word: wordOf(alert.unwatched.state), level: "warning" };
  return { sign, word, level: levelOf(alert) };
}

/** Returns whether the present data say nothing about a part that was normal. */
export function isBlind(alert) {
  return alert?.state === "normal" && alert.unwatched?.state === "blind";
}

/** Returns whether the alert of a part has no decision, so that its probability of loss means nothing yet. */
export function isUndecided(alert) {
  return alert?.state === "undecided";
}

/** Returns whether the newest probability of loss of a part is no finding: its alert is undecided or not confirmed. */
export function isOpen(alert) {
  return isUndecided(alert) || alert?.state === "unconfirmed";
}

/** Returns a probability behind the state of an alert without a finding, or else the probability alone. */
export function openWords(alert, told) {
  return isOpen(alert) ? t("open-state", STATES[alert.state].word, told) : told;
}

/**
 * Returns the estimate of a part that belongs to its probability of loss, as the alert judges it. Its
 * interval contains the uncertainty of the reference and is wider than that of the filter.
 */
export function judgedEstimate({ loss, low, high }, reference) {
  return { mean: (1 - loss) * reference, low: (1 - high) * reference, high: (1 - low) * reference };
}

/**
 * Returns when an alert changed to its state (s): the wall-clock time of an acknowledgement, or else the
 * measurement time.
 */
export function changedAt({ state, changed_ns: changed, acknowledged_ns: acknowledged }) {
  return (state === "acknowledged" && acknowledged !== null ? acknowledged : changed) / 1e9;
}

/**
 * Formats a time of an alert (s). A lasting loss is found on a day, which is one of UTC, and acknowledged or
 * cleared at a moment.
 */
export function timeOfAlert(alert, seconds) {
  return isLasting(alert) && alert.state === "raised" ? dateOf(seconds) : time(seconds);
}

/**
 * Formats when an alert changed to its state. A lasting loss that was found again can be raised after the day on
 * which it was found.
 */
export function timeOfChange(alert) {
  const isFound = isLasting(alert) && alert.state === "raised";
  return timeOfAlert(alert, isFound ? alert.found_ns / 1e9 : changedAt(alert));
}

/**
 * Returns the state of an alert with the time of its change. Of an acknowledged one, also when it was raised
 * (`raised_ns`), if that is known.
 */
export function whenWords(alert) {
  const { state, raised_ns: raised } = alert;
  const changed = `${STATES[state].word} ${timeOfChange(alert)}`;
  if (state !== "acknowledged" || raised == null) return changed;
  return `${STATES.raised.word} ${timeOfAlert({ ...alert, state: "raised" }, raised / 1e9)} · ${changed}`;
}

/**
 * Returns by whom an alert was acknowledged with the note, if its sentence does not say so, and when, if that is
 * not the time of its change. Empty if it was not acknowledged.
 */
export function seenWords({ state, why, acknowledged_by: who, acknowledged_ns: at, note: text }) {
  if (!who) return "";
  const note = text ? `: ${text}` : "";
  const isTold = why.includes(`acknowledged by ${who}${note}`);
  if (at === null || state === "acknowledged") return isTold ? "" : t("alert-seen-by", who, note);
  return isTold ? t("alert-seen-on", time(at / 1e9)) : t("alert-seen-by-on", who, time(at / 1e9), note);
}

/**
 * Returns when the newest loss of an alert was published, if that was after the alert changed to its state. Of a
 * lasting loss, it is the last judged day.
 */
export function revisedWords(alert) {
  const { changed_ns: changed, time_ns: newest } = alert;
  return newest > changed ? t("revised-at", isLasting(alert) ? dateOf(newest / 1e9) : time(newest / 1e9)) : "";
}

/** Probability of a loss above which only the loss distinguishes parts. The server has the same limit. */
const CERTAIN = 0.999;

/** Orders probable losses { probability, loss }, the most severe first. */
export function bySeverity(a, b) {
  return Math.min(b.probability, CERTAIN) - Math.min(a.probability, CERTAIN) || b.loss - a.loss;
}

/** Returns whether an alert is a lasting loss, and not that of a rule. */
export function isLasting({ kind }) {
  return kind === "lasting-loss";
}

/** Returns a key of an alert: a quantity can have the name of a parameter. */
export function keyOfAlert({ kind, structure, parameter }) {
  return `${kind}/${structure}/${parameter}`;
}

/** Returns the state of an alert in words, and its kind if it is a lasting loss. */
export function stateWords(alert) {
  return `${STATES[alert.state].word}${isLasting(alert) ? ` (${wordOf(alert.kind)})` : ""}`;
}

/** Returns whether an alert can be acknowledged. */
export function canBeSeen(alert) {
  return ["raised", "cleared"].includes(alert.state) || (alert.state === "unconfirmed" && !alert.acknowledged_by);
}

/** Returns the verdict on the fit in one word. */
export function fitWord({ fit: verdict, ended, age_s }) {
  // A verdict on the past has no sign of the present.
  if (verdict && (ended || age_s === null || age_s > STALE_S)) return t("last-known", wordOf(verdict));
  return verdict ? `${FITS[verdict].sign}\u00a0${wordOf(verdict)}` : t("not-judged");
}

/** Steps of the probability of loss, shared by the drawing and its key. */
export const STEPS = [
  { below: 0.5, text: t("below-50-per-cent") },
  { below: 0.95, text: t("50-to-95-per-cent") },
  { below: 0.99, text: t("95-to-99-per-cent") },
  { below: Infinity, text: t("99-per-cent-and-above") },
];

/** Returns the step of a probability, or null if it is unknown. */
export function step(probability) {
  if (probability === null || probability === undefined) return null;
  return STEPS.findIndex((one) => probability < one.below);
}

/** Maximum number of decimals of a probability in per cent. */
const MOST_DIGITS = 6;

/**
 * Formats a probability in per cent, never as certainty, and with enough digits to show on which
 * side of `asked` it is.
 */
export function probability(value, asked) {
  if (value === null || value === undefined) return "–";
  const percent = 100 * value;
  for (let digits = percent > 10 && percent < 99 ? 0 : 1; ; digits += 1) {
    const most = 100 - 10 ** -Math.max(digits, 1);
    const bound = percent > most ? [most, 100, "> "] : percent < 100 - most ? [0, 100 - most, "< "] : null;
    const shown = bound ? (bound[2] === "> " ? most : 100 - most) : percent;
    const rounded = Number(shown.toFixed(digits));
    const [low, high, sign] = bound ?? [rounded, rounded, ""];
    const isTold = value >= asked ? low / 100 >= asked : high / 100 < asked;
    if (asked === null || asked === undefined || isTold || digits === MOST_DIGITS) return `${sign}${fixed(shown, digits)} %`;
  }
}

/** Formats a share in per cent. */
export function percent(share, digits = 1) {
  return `${fixed(100 * share, digits)} %`;
}

/** Formats a ratio to the nominal value. */
export function ratio(value) {
  return fixed(value, 3);
}

/** Formats a number of any size with few digits. */
export function number(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return typeset(value.toExponential(2));
  return typeset(String(Number(value.toPrecision(4))));
}

/**
 * Formats a measured value with three significant digits, also if they are zeros, so that the values of
 * a table can be compared.
 */
function measured(value) {
  const size = Math.abs(value);
  return size >= 1e-3 && size < 1e3 ? typeset(value.toPrecision(3)) : number(value);
}

/** Formats a mean. A small one has the decimals of the RMS beside it, and no power of ten. */
function meanBeside({ mean, rms }) {
  if (!(Math.abs(mean) < 1e-3 && rms >= 1e-3 && rms < 1e3)) return measured(mean);
  const text = mean.toFixed(Math.max(0, 2 - Math.floor(Math.log10(rms))));
  return typeset(Number(text) === 0 ? text.replace("-", "") : text);
}

/** Returns a number as people read it, with a minus sign and a power of ten: −1.25·10⁻⁴. */
export function typeset(text) {
  const [digits, exponent] = text.split("e");
  return inLanguage(digits).replace("-", "−") + (exponent === undefined ? "" : `·${powerOfTen(Number(exponent))}`);
}

/** Returns a power of ten: 10⁻⁴. */
export function powerOfTen(exponent) {
  const digits = [...String(Math.abs(exponent))].map((digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]);
  return `10${exponent < 0 ? "⁻" : ""}${digits.join("")}`;
}

/** Formats a whole number, with its thousands apart. */
export function count(value) {
  return String(value).replaceAll(/\B(?=(\d{3})+$)/g, "\u202f");
}

/** Formats an amount of payload. */
export function bytes(count) {
  if (count < 1000) return `${count} B`;
  if (count < 1e6) return `${fixed(count / 1e3, 1)} kB`;
  return `${fixed(count / 1e6, 1)} MB`;
}

/**
 * Formats the lag of the identification behind the sensors. It has no meaning for a record or a
 * simulation.
 */
export function lag(seconds, replayed) {
  if (replayed) return t("replayed-or-simulated");
  if (seconds === null) return "–";
  if (seconds < -1) return t("ahead-of-time", duration(seconds));
  return duration(Math.max(seconds, 0));
}

/** Returns the name of a channel with its quantity, as in the structure file. */
export function sensorName({ channel, quantity, unit: of }) {
  return `${channel} (${wordOf(quantity)}, ${unit(of)})`;
}

/** What the comparison of a channel with the others shows, if it is at fault. */
const FAULTS = {
  gain: ({ gain }) => t("times-the-motion-of-the-others", number(gain)),
  sign: () => t("opposite-sign"),
  delay: ({ delay_s }) => t("ms-the-others", Math.abs(1000 * delay_s).toFixed(0), delay_s < 0 ? t("before") : t("after")),
  dead: () => t("does-not-follow-the-others"),
  disturbed: () => t("measures-something-that-the-others-do-not"),
  drift: () => t("its-offset-drifts"),
  clipped: () => t("its-peaks-are-cut-off"),
  exchanged: () => t("exchanged-with-another-one"),
};

/** Returns how a channel compares with the others, in the columns of the table of sensors. */
export function compared(channel) {
  if (!channel || channel.gain === null) return { relation: "–", fault: "–" };
  const [size, ms] = [typeset(channel.gain.toFixed(2)), Math.round(1000 * channel.delay_s)];
  const factor = ms === 0 ? t("factor-in-step", size) : t("factor-delay-ms", size, Math.abs(ms), ms < 0 ? t("earlier") : t("later"));
  return { relation: channel.fault ? FAULTS[channel.fault](channel) : factor, fault: probability(channel.probability) };
}

/**
 * Returns when the node of a sensor samples relative to the frames, and the state of its clock with
 * the quality that its source states.
 * `isReported` states whether ingest reports on clocks at all.
 */
export function clockWords(clock, isReported) {
  if (!clock) return isReported ? { offset: t("at-the-frames"), clock: t("agrees") } : { offset: "–", clock: "–" };
  const ms = (seconds) => `${fixed(1000 * seconds, 2)} ms`;
  const jitter = clock.jitter_s > 0 ? t("varies-by", ms(clock.jitter_s)) : "";
  const isAtFrames = clock.offset_s === 0 && clock.jitter_s === 0;
  const offset = isAtFrames ? t("at-the-frames") : `${ms(Math.abs(clock.offset_s))} ${clock.offset_s < 0 ? t("before") : t("after")}${jitter}`;
  const quality = clock.quality_percent == null ? "" : t("stated-quality", percent(clock.quality_percent / 100, 0));
  const difference = clock.difference_s ?? 0;
  if (!difference) return { offset, clock: t("agrees") + quality };
  return { offset: "–", clock: `▲ ${Math.abs(difference).toFixed(0)} s ${difference < 0 ? t("behind") : t("ahead")}${quality}` };
}

/** Returns the samples of the last minute of a sensor, in the columns of their table. */
export function levelWords(level, of) {
  if (!level) return ["–", "–", "–", "–", "–"];
  const values = [meanBeside(level), measured(level.rms), measured(level.peak)].map((value) => `${value} ${unit(of)}`);
  return [number(level.rate_hz), ...values, `${measured(level.last)} ${unit(of)}, ${time(level.last_s)}`];
}

/** Returns the level, sign and words of a condition, such as a temperature. */
export function conditionWords({ name, unit: of, value, age_s, stale, implausible, instrument }) {
  if (value === null) return { level: "learning", text: t("no-value-yet", name) };
  const fault = stale ? t("the-next-value-is-overdue") : implausible ? t("outside-its-plausible-range") : "";
  const by = instrument ? ` (${instrument})` : "";
  return { level: fault ? "warning" : "normal", text: t("ago", fault ? "▲" : "●", name, number(value), unit(of), duration(age_s), fault, by) };
}

/** Returns the level of a declared mode, and its words in the columns of the table of modes. */
export function modeWords({ mode, time_ns: end, state, partner, estimate, presence, machine }) {
  const isSure = state === "tracked" && !machine;
  const level = isSure ? "normal" : state === "missing" && presence > 0.5 ? "learning" : "warning";
  const { frequency_hz: f, frequency_std_hz: std, damping, damping_std: dampingStd } = estimate ?? {};
  const found = estimate ? [`${fixed(f, 4)} Hz`, t("range-in-unit", fixed(f - 1.96 * std, 4), fixed(f + 1.96 * std, 4), "Hz"), `${percent(damping, 2)} ± ${percent(dampingStd, 2)}`] : ["–", "–", "–"];
  const told = `${LEVELS[level].sign}\u00a0${wordOf(state)}${partner ? t("with", partner) : ""}${machine ? `. ${t("a-machine-runs-at-this-frequency")}` : ""}`;
  return { level, cells: [mode, told, ...found, time(end / 1e9), percent(presence, 0)] };
}

/**
 * Levels of the words of a judgement. The others say nothing about the structure. Without a value, a
 * condition or a reference, a loss would not be noticed.
 */
const JUDGEMENTS = { judged: "normal", stiffer: "warning", "lasting-loss": "alarm", "learned-away": "alarm", "no-statement": "warning", "not-ready": "warning" };

/** Returns the level, sign and words of the judgement of a quantity. */
export function judgementWords({ word: judged, sentence, change, seen, epoch_ns: epoch, measured }) {
  const level = seen ? "notice" : (JUDGEMENTS[judged] ?? "learning");
  const parts = [`${LEVELS[level].sign} ${wordOf(judged)}: ${sentence}`];
  if (change) parts.push(t("found-on", dateOf(change.found_ns / 1e9)));
  if (seen) parts.push(t("judgement-seen-by", seen.who, seen.text));
  parts.push(epoch === null ? t("no-epoch-yet") : t("last-epoch", time(epoch / 1e9)));
  if (!measured) parts.push(t("contains-replayed-or-simulated-samples"));
  return { level, text: parts.join(" ") };
}

const signed = (value, digits) => {
  const isZero = Number(value.toFixed(digits)) === 0;
  return `${isZero ? "" : value < 0 ? "−" : "+"}${fixed(Math.abs(value), digits)}`;
};

/** Returns a value of a compared quantity, with the decimals of its kind. */
export function comparedValue(value, of) {
  return of ? `${fixed(value, 4)} ${of}` : ratio(value);
}

/**
 * Returns the level and the words of a difference of two means. Its sign is only known if the interval
 * excludes zero.
 */
export function comparedMeans(change, first) {
  if (!change) return { level: "learning", difference: "–", interval: "–", result: t("no-data-in-both-ranges"), sentence: null };
  const share = (value) => signed((100 * value) / first.mean, 2);
  const isClear = (change.low > 0 || change.high < 0) && !change.isByChance;
  const direction = change.difference < 0 ? t("lower") : t("higher");
  const [near, far] = [change.low, change.high].map((end) => Math.abs((100 * end) / first.mean)).sort((a, b) => a - b);
  return {
    level: isClear ? "warning" : "normal",
    difference: `${share(change.difference)} %`,
    interval: t("to-per-cent", share(change.low), share(change.high)),
    result: isClear ? t("in-the-second-range", direction) : change.isByChance ? t("possible-by-chance") : t("no-difference-shown"),
    sentence: isClear ? t("is-per-cent-in-the-second-range", fixed(Math.abs((100 * change.difference) / first.mean), 1), direction, fixed(near, 1), fixed(far, 1), direction) : null,
  };
}

/** Returns coordinates in words: 47.3760° N, 8.5470° E. Empty without any. */
export function coordinatesOf(at) {
  if (!at) return "";
  return `${fixed(Math.abs(at.latitude), 4)}° ${at.latitude < 0 ? "S" : "N"}, ${fixed(Math.abs(at.longitude), 4)}° ${at.longitude < 0 ? "W" : "E"}`;
}

/** Returns the unit of a power spectral density. Only a unit of several symbols is in parentheses. */
export function densityUnit(of) {
  return `${unit(of).replace(/^.*[^\p{L}].*$/u, "($&)")}²/Hz`;
}

/** Formats the distance of a node from the others, with the same decimals for all nodes. */
export function distanceWords(distance) {
  return distance < 1e5 ? fixed(distance, 2) : number(distance);
}

/** Returns a unit with typographic symbols. */
export function unit(text) {
  return text.replace("m/s2", "m/s²").replace("W/m2", "W/m²").replace("degC", "°C").replace(/^deg$/, "°").replace(/^um$/, "µm").replace("microstrain", "µm/m");
}
