// Names of states and formats of numbers. The formats of times and addresses are beside it.

import { duration, time } from "./time.js";

export * from "./address.js";
export * from "./time.js";

/** Names and signs of the levels of attention. Sign and word distinguish them without colour. */
export const LEVELS = {
  alarm: { sign: "▲", word: "Alarm" },
  stale: { sign: "✕", word: "No data" },
  warning: { sign: "◆", word: "Warning" },
  notice: { sign: "●", word: "Seen" },
  undecided: { sign: "?", word: "Undecided" },
  learning: { sign: "…", word: "Learning" },
  normal: { sign: "✓", word: "Normal" },
};

/** Names of the tabs of a structure, and the texts above their contents. */
export const TABS = { now: "Now", parameters: "Parameters", lasting: "Lasting change", model: "Model", sensors: "Sensors", events: "Events", settings: "Settings" };

/** Titles of the columns of the tables. */
export const COLUMNS = {
  parts: ["Part", "State", "Estimate", "95 % interval", "Probability of loss"],
  sensors: ["Sensor", "Quantity", "Node", "State", "Last sample used", "Compared with the others", "Probability of a fault", "Sampling instant", "Clock", "Rejected"],
  levels: ["Sensor", "State", "Samples per second", "Mean", "RMS", "Peak", "Last sample"],
  events: ["Time", "About", "What happened", ""],
  services: ["Service", "State", "Lag", "Items processed", "Dropped or corrected"],
  delays: ["Loss of stiffness", "Found after (median)", "Found within 30 days"],
  rules: ["Parameters", "Loss", "Probability required", "Duration required"],
};

/** Titles of the axes. All of these quantities have no unit. */
export const AXES = {
  stiffness: "stiffness / design stiffness",
  ratio: "value / design value",
  plausibility: "plausibility",
  distance: "distance from the others",
  consistency: "per channel",
  damping: "noise level ψ",
};

/** Words for a parameter without a state. */
export const NO_RULE = "– no alert rule";
export const NOT_STIFFNESS = "not a stiffness";

/** Number of parts or structures above which a search field is shown. */
export const SEARCH_ABOVE = 12;

const collator = new Intl.Collator("en", { numeric: true });

/** Compares names in their natural order: `storey-2` is before `storey-10`. */
export function natural(a, b) {
  return collator.compare(a, b);
}

/** Names, signs and levels of the states of an alert. */
export const STATES = {
  raised: { sign: "▲", word: "raised", level: "alarm" },
  unconfirmed: { sign: "△", word: "unconfirmed", level: "alarm" },
  pending: { sign: "◆", word: "pending", level: "warning" },
  "softening-in-motion": { sign: "≈", word: "softening in motion", level: "notice" },
  acknowledged: { sign: "●", word: "acknowledged", level: "notice" },
  cleared: { sign: "○", word: "cleared", level: "notice" },
  undecided: { sign: "?", word: "undecided", level: "learning" },
  learning: { sign: "…", word: "learning", level: "learning" },
  normal: { sign: "✓", word: "normal", level: "normal" },
};

/** Signs and levels of the verdicts on the fit. */
export const FITS = {
  supported: { sign: "✓", level: "normal" },
  doubtful: { sign: "◆", level: "learning" },
  contradicted: { sign: "✕", level: "warning" },
};

/** Names, signs and levels of the health of sensors. */
export const HEALTH = {
  alive: { sign: "●", word: "delivers", level: "normal" },
  gone: { sign: "✕", word: "gone", level: "warning" },
  silent: { sign: "✕", word: "silent", level: "warning" },
  "wrong-clock": { sign: "✕", word: "wrong clock, not used", level: "warning" },
  "in-doubt": { sign: "▲", word: "in doubt", level: "warning" },
  faulty: { sign: "▲", word: "faulty, not used", level: "warning" },
  excluded: { sign: "◆", word: "excluded: disagrees with the others", level: "warning" },
  ended: { sign: "■", word: "record has ended", level: "learning" },
  unknown: { sign: "○", word: "not known yet", level: "learning" },
};

/** Names, signs and levels of the states of distributed nodes. */
export const NODES = {
  used: { sign: "●", word: "alive", level: "normal" },
  silent: { sign: "○", word: "silent", level: "warning" },
  excluded: { sign: "◆", word: "excluded: disagrees with the others", level: "warning" },
  ended: { sign: "■", word: "ended", level: "learning" },
};

/** Returns the level of an alert. An acknowledged alert is not an alarm. */
export function levelOf(alert) {
  return alert.state === "unconfirmed" && alert.acknowledged_by ? "notice" : STATES[alert.state].level;
}

/** Returns sign, word and level of a parameter: normal only if damage would be noticed. */
export function stateOf(alert) {
  const { sign, word } = STATES[alert.state];
  if (alert.state === "normal" && alert.unwatched) return { sign: "○", word: alert.unwatched.state, level: "warning" };
  return { sign, word, level: levelOf(alert) };
}

/** Returns whether an alert can be acknowledged. */
export function canBeSeen(alert) {
  return ["raised", "cleared"].includes(alert.state) || (alert.state === "unconfirmed" && !alert.acknowledged_by);
}

/** Returns the verdict on the fit in one word. */
export function fitWord(verdict) {
  return verdict ? `${FITS[verdict].sign} ${verdict}` : "not judged";
}

/** Steps of the probability of loss, shared by the drawing and its key. */
export const STEPS = [
  { below: 0.05, text: "below 5 %" },
  { below: 0.5, text: "5 to 50 %" },
  { below: 0.95, text: "50 to 95 %" },
  { below: 0.99, text: "95 to 99 %" },
  { below: Infinity, text: "99 % and above" },
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
    const text = (bound ? (bound[2] === "> " ? most : 100 - most) : percent).toFixed(digits);
    const [low, high, sign] = bound ?? [Number(text), Number(text), ""];
    const isTold = value >= asked ? low / 100 >= asked : high / 100 < asked;
    if (asked === null || asked === undefined || isTold || digits === MOST_DIGITS) return `${sign}${text} %`;
  }
}

/** Formats a share in per cent. */
export function percent(share, digits = 1) {
  return `${(100 * share).toFixed(digits)} %`;
}

/** Formats a ratio to the nominal value. */
export function ratio(value) {
  return value.toFixed(3);
}

/** Formats a number of any size with few digits. */
export function number(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

/** Formats an amount of payload. */
export function bytes(count) {
  if (count < 1000) return `${count} B`;
  if (count < 1e6) return `${(count / 1e3).toFixed(1)} kB`;
  return `${(count / 1e6).toFixed(1)} MB`;
}

/**
 * Formats the lag of the identification behind the sensors. It has no meaning for a record or a
 * simulation.
 */
export function lag(seconds, replayed) {
  if (replayed) return "replayed or simulated";
  if (seconds === null) return "–";
  if (seconds < -1) return `−${duration(seconds)} (ahead of time)`;
  return duration(Math.max(seconds, 0));
}

/** Returns the name of a channel with its quantity, as in the structure file. */
export function sensorName({ channel, quantity, unit: of }) {
  return `${channel} (${quantity.replaceAll("-", " ")}, ${unit(of)})`;
}

/** What the comparison of a channel with the others shows, if it is at fault. */
const FAULTS = {
  gain: ({ gain }) => `${number(gain)} times the motion of the others`,
  sign: () => "opposite sign",
  delay: ({ delay_s }) => `${Math.abs(1000 * delay_s).toFixed(0)} ms ${delay_s < 0 ? "before" : "after"} the others`,
  dead: () => "does not follow the others",
  disturbed: () => "measures something that the others do not",
  drift: () => "its offset drifts",
  clipped: () => "its peaks are cut off",
  exchanged: () => "exchanged with another one",
};

/** Returns how a channel compares with the others, in the columns of the table of sensors. */
export function compared(channel) {
  if (!channel || channel.gain === null) return { relation: "–", fault: "–" };
  const factor = `factor ${channel.gain.toFixed(2)}, delay ${(1000 * channel.delay_s).toFixed(0)} ms`;
  return { relation: channel.fault ? FAULTS[channel.fault](channel) : factor, fault: probability(channel.probability) };
}

/**
 * Returns when the node of a sensor samples relative to the frames, and the state of its clock.
 * `isReported` states whether ingest reports on clocks at all.
 */
export function clockWords(clock, isReported) {
  if (!clock) return isReported ? { offset: "at the frames", clock: "✓ agrees" } : { offset: "–", clock: "–" };
  const ms = (seconds) => `${(1000 * seconds).toFixed(2)} ms`;
  const jitter = clock.jitter_s > 0 ? `, varies by ${ms(clock.jitter_s)}` : "";
  const offset = `${ms(Math.abs(clock.offset_s))} ${clock.offset_s < 0 ? "before" : "after"}${jitter}`;
  const difference = clock.difference_s ?? 0;
  if (!difference) return { offset, clock: "✓ agrees" };
  return { offset: "–", clock: `▲ ${Math.abs(difference).toFixed(0)} s ${difference < 0 ? "behind" : "ahead"}` };
}

/** Returns the samples of the last minute of a sensor, in the columns of their table. */
export function levelWords(level, of) {
  if (!level) return ["–", "–", "–", "–", "–"];
  const values = [level.mean, level.rms, level.peak].map((value) => `${number(value)} ${unit(of)}`);
  return [number(level.rate_hz), ...values, `${number(level.last)} ${unit(of)}, ${time(level.last_s)}`];
}

/** Returns the level, sign and words of a condition, such as a temperature. */
export function conditionWords({ name, unit: of, value, age_s, stale, implausible, instrument }) {
  if (value === null) return { level: "learning", text: `○ ${name}: no value yet` };
  const fault = stale ? ", the next value is overdue" : implausible ? ", outside its plausible range" : "";
  const by = instrument ? ` (${instrument})` : "";
  return { level: fault ? "warning" : "normal", text: `${fault ? "▲" : "●"} ${name}: ${number(value)} ${unit(of)}, ${duration(age_s)} ago${fault}${by}` };
}

/** Returns the level, sign and words of a declared mode. */
export function modeWords({ mode, time_ns: end, state, partner, estimate, presence, machine }) {
  const isSure = state === "tracked" && !machine;
  const level = isSure ? "normal" : state === "missing" && presence > 0.5 ? "learning" : "warning";
  const parts = [`${LEVELS[level].sign} ${mode}:`];
  if (estimate) {
    const { frequency_hz: f, frequency_std_hz: std, damping, damping_std: dampingStd } = estimate;
    parts.push(`${f.toFixed(4)} Hz [${(f - 1.96 * std).toFixed(4)}, ${(f + 1.96 * std).toFixed(4)}], damping ${percent(damping, 2)} ± ${percent(dampingStd, 2)}.`);
  }
  parts.push(`${state}${partner ? ` with ${partner}` : ""} in the epoch to ${time(end / 1e9)}, found in ${percent(presence, 0)} of the last 20 epochs.`);
  if (machine) parts.push("A machine runs at this frequency.");
  return { level, text: parts.join(" ") };
}

/** Levels of the words of a judgement. The others say nothing about the structure. */
const JUDGEMENTS = { judged: "normal", stiffer: "warning", "lasting-loss": "alarm", "learned-away": "alarm" };

/** Returns the level, sign and words of the judgement of a quantity. */
export function judgementWords({ word, sentence, change, seen, epoch_ns: epoch, measured }) {
  const level = seen ? "notice" : (JUDGEMENTS[word] ?? "learning");
  const parts = [`${LEVELS[level].sign} ${word}: ${sentence}`];
  if (change) parts.push(`Found on ${new Date(change.found_ns / 1e6).toISOString().slice(0, 10)}.`);
  if (seen) parts.push(`Seen by ${seen.who}: ${seen.text}.`);
  parts.push(epoch === null ? "No epoch yet." : `Last epoch ${time(epoch / 1e9)}.`);
  if (!measured) parts.push("Contains replayed or simulated samples.");
  return { level, text: parts.join(" ") };
}

/** Returns a unit with typographic symbols. */
export function unit(text) {
  return text.replace("m/s2", "m/s²").replace("W/m2", "W/m²").replace("degC", "°C").replace(/^deg$/, "°").replace(/^um$/, "µm").replace("microstrain", "µm/m");
}
