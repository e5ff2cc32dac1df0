// Names of states and formats of numbers.

/** What a level of attention is called, and its sign: shape and word tell it without colour. */
export const LEVELS = {
  alarm: { sign: "▲", word: "Alarm" },
  stale: { sign: "✕", word: "No data" },
  warning: { sign: "◆", word: "Warning" },
  notice: { sign: "●", word: "Seen" },
  undecided: { sign: "?", word: "Undecided" },
  learning: { sign: "…", word: "Learning" },
  normal: { sign: "✓", word: "Normal" },
};

/** The same for the states of an alert. */
export const STATES = {
  raised: { sign: "▲", word: "raised", level: "alarm" },
  unconfirmed: { sign: "△", word: "unconfirmed", level: "alarm" },
  pending: { sign: "◆", word: "pending", level: "warning" },
  acknowledged: { sign: "●", word: "acknowledged", level: "notice" },
  cleared: { sign: "○", word: "cleared", level: "notice" },
  undecided: { sign: "?", word: "undecided", level: "learning" },
  learning: { sign: "…", word: "learning", level: "learning" },
  normal: { sign: "✓", word: "normal", level: "normal" },
};

/** And for verdicts on the fit. */
export const FITS = {
  supported: { sign: "✓", level: "normal" },
  doubtful: { sign: "◆", level: "learning" },
  contradicted: { sign: "✕", level: "warning" },
};

/** And for sensors. */
export const HEALTH = {
  alive: { sign: "●", word: "delivers", level: "normal" },
  gone: { sign: "✕", word: "gone", level: "warning" },
  silent: { sign: "✕", word: "silent", level: "warning" },
  faulty: { sign: "▲", word: "faulty, not used", level: "warning" },
  excluded: { sign: "◆", word: "excluded: disagrees with the others", level: "warning" },
  ended: { sign: "■", word: "record has ended", level: "learning" },
  unknown: { sign: "○", word: "not heard of yet", level: "learning" },
};

/** And for nodes that identify for themselves. */
export const NODES = {
  used: { sign: "●", word: "alive", level: "normal" },
  silent: { sign: "○", word: "silent", level: "warning" },
  excluded: { sign: "◆", word: "excluded: disagrees with the others", level: "warning" },
  ended: { sign: "■", word: "ended", level: "learning" },
};

/** The level of an alert: one that stands and that somebody has seen is no alarm. */
export function levelOf(alert) {
  return alert.state === "unconfirmed" && alert.acknowledged_by ? "notice" : STATES[alert.state].level;
}

/** Whether somebody can acknowledge an alert. */
export function canBeSeen(alert) {
  return ["raised", "cleared"].includes(alert.state) || (alert.state === "unconfirmed" && !alert.acknowledged_by);
}

/** The verdict on the fit in one word. */
export function fitWord(verdict) {
  return verdict ? `${FITS[verdict].sign} ${verdict}` : "not judged";
}

/** Steps of the probability of loss: the drawing and its key use the same. */
export const STEPS = [
  { below: 0.05, text: "below 5 %" },
  { below: 0.5, text: "5 to 50 %" },
  { below: 0.95, text: "50 to 95 %" },
  { below: 0.99, text: "95 to 99 %" },
  { below: Infinity, text: "99 % and above" },
];

/** The step of a probability; none where it is not known. */
export function step(probability) {
  if (probability === null || probability === undefined) return null;
  return STEPS.findIndex((one) => probability < one.below);
}

/** Most digits after the point of a probability in per cent. */
const MOST_DIGITS = 6;

/** A probability in per cent, without a certainty that nobody has, and on the side of the one asked for on which it lies. */
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

/** A share in per cent. */
export function percent(share, digits = 1) {
  return `${(100 * share).toFixed(digits)} %`;
}

/** A ratio to the nominal value. */
export function ratio(value) {
  return value.toFixed(3);
}

/** A number of any size in few digits. */
export function number(value) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

/** An amount of payload. */
export function bytes(count) {
  if (count < 1000) return `${count} B`;
  if (count < 1e6) return `${(count / 1e3).toFixed(1)} kB`;
  return `${(count / 1e6).toFixed(1)} MB`;
}

/** Times before this are those of a record that begins at 0: three years, longer than any. */
const WITHOUT_DATES_BEFORE_S = 1e8;

/** How long something is, in words. */
export function duration(seconds) {
  const size = Math.abs(seconds);
  if (size < 1) return `${size.toFixed(1)} s`;
  if (size < 120) return `${Math.round(size)} s`;
  if (size < 7200) return `${Math.round(size / 60)} min`;
  if (size < 48 * 3600) return `${Math.round(size / 3600)} h`;
  return `${Math.round(size / 86400)} days`;
}

/** Whether a time is that of a record that begins at 0. */
export function isWithoutDate(seconds) {
  return Math.abs(seconds) < WITHOUT_DATES_BEFORE_S;
}

/** A time of measurement, UTC as in the sentences of the alerts; of a record without dates the second of the record. */
export function time(seconds) {
  if (isWithoutDate(seconds)) return `${seconds.toFixed(2)} s`;
  return new Date(1000 * seconds).toISOString().replace("T", " ").replace(/\.\d+Z/, " UTC");
}

/** The time of day alone; of a record without dates the second of the record. */
export function clock(seconds) {
  if (isWithoutDate(seconds)) return time(seconds);
  return `${new Date(1000 * seconds).toISOString().slice(11, 21)} UTC`;
}

/** A time of a record without dates, in hours, minutes and seconds: 0:01:30. */
export function recordTime(seconds, digits = 0) {
  const unit = 10 ** digits;
  const size = Math.round(Math.abs(seconds) * unit) / unit;
  const [hours, minutes] = [Math.floor(size / 3600), Math.floor(size / 60) % 60];
  const rest = (size % 60).toFixed(digits).padStart(digits ? 3 + digits : 2, "0");
  return `${seconds < 0 && size > 0 ? "−" : ""}${hours}:${String(minutes).padStart(2, "0")}:${rest}`;
}

/** How far behind the sensors the identification is; the times of a record or a simulation say nothing of it. */
export function lag(seconds, replayed) {
  if (replayed) return "replayed or simulated";
  if (seconds === null) return "–";
  if (seconds < -1) return `−${duration(seconds)} (ahead of time)`;
  return duration(Math.max(seconds, 0));
}

/** A channel with what it measures, as the structure file names it. */
export function sensorName({ channel, quantity, unit: of }) {
  return `${channel} (${quantity.replaceAll("-", " ")}, ${unit(of)})`;
}

/** Units as people write them. */
export function unit(text) {
  return text.replace("m/s2", "m/s²");
}

/** Address of a structure's page, with a moment and a parameter if there is one. */
export function place(structure, parameter, seconds) {
  const query = new URLSearchParams();
  if (parameter) query.set("parameter", parameter);
  if (seconds) query.set("at", seconds.toFixed(3));
  const text = query.toString();
  return `#/structure/${encodeURIComponent(structure)}${text ? `?${text}` : ""}`;
}
