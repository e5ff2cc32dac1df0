// All structures, the most urgent first.

import { h, keyed, setAttribute, setText } from "./dom.js";
import { report } from "./events.js";
import { language, t } from "./language.js";
import { StructureMap } from "./map.js";
import { searchField } from "./search.js";
import { Sparklines } from "./sparklines.js";
import { HEALTH, LEVELS, SEARCH_ABOVE, SERVICES, STATES, URGENCIES, attentionWords, duration, fitWord, lag, natural, percent, place, probability, ratio, rememberFilters, setSentence, stateWords, time, timeOfAlert, withMinus, wordOf } from "./words.js";

/** Maximum number of sensors that a card names. */
const MOST_SENSORS = 4;
/** Lag above which data are not new (s). The server warns from the same one. */
const LATE_S = 10;

export class OverviewPage {
  constructor(connection, parameters = new URLSearchParams()) {
    this.connection = connection;
    this.wanted = parameters.get("find") ?? "";
    this.summary = h("p", { class: "summary" }, t("loading"));
    this.list = h("ul", { class: "structures" });
    const heads = { state: t("state"), name: t("structure"), reason: t("reason"), fit: t("fit"), sensors: t("sensors-alive"), trend: t("last-day") };
    // Each row states the same, so the titles are only for the eye.
    this.heads = h("div", { class: "structure-heads", "aria-hidden": "true", hidden: true }, Object.entries(heads).map(([key, text]) => h("span", { class: `head-${key}` }, text)));
    this.none = h("p", { class: "empty", hidden: true }, t("no-structure-matches-the-search"));
    this.map = new StructureMap();
    this.tools = h("div", { class: "tools" });
    this.reported = h("ol", { class: "reported" });
    this.quakes = h("section", { class: "card", "aria-labelledby": "after-earthquake", hidden: true }, h("h2", { id: "after-earthquake" }, t("after-the-earthquake")), this.reported);
    this.element = h("div", { class: "overview" }, h("h1", {}, t("structures")), this.summary, this.quakes, this.tools, this.heads, this.list, this.none, this.map.element);
    this.lines = new Sparklines();
    connection.listen(null);
    this.leave = connection.on("overview", (message) => this.show(message));
  }

  close() {
    this.leave();
    this.lines.close();
    this.map.close();
  }

  #find() {
    rememberFilters("", { find: this.search.text() });
    this.show({ structures: this.structures });
  }

  show({ structures: all }) {
    const structures = all.toSorted((a, b) => urgency(a) - urgency(b) || natural(a.name, b.name));
    const shaken = structures.filter(({ earthquake }) => earthquake).toSorted(byUrgency);
    const { level, text } = summary(structures, shaken);
    setText(this.summary, text);
    this.summary.dataset.level = level;
    // Only many structures need a search and short cards.
    this.search ??= searchField(structures.length, t("find-a-structure"), () => this.#find(), this.wanted);
    if (this.search.element && !this.search.element.parentElement) this.tools.append(this.search.element);
    this.structures = structures;
    this.quakes.hidden = shaken.length === 0;
    keyed(this.reported, shaken, ({ name }) => name, makeReported, updateReported);
    const isMany = structures.length > SEARCH_ABOVE;
    this.list.classList.toggle("is-many", isMany);
    this.heads.hidden = !isMany;
    // Few cards fit on a screen, and the first alarm must be on it. Many are found on the map first.
    if (isMany && this.map.element.nextSibling !== this.tools) this.tools.before(this.map.element);
    const found = structures.filter((one) => this.search.finds(`${one.name} ${one.description} ${one.sentence} ${attentionWords(one).word}`));
    this.map.show(found);
    this.none.hidden = found.length > 0 || structures.length === 0;
    const make = (structure) => {
      const card = makeCard(structure);
      this.lines.watch(card.trend, structure.name);
      return card;
    };
    keyed(this.list, found, (structure) => structure.name, make, (card, structure) => {
      updateCard(card, structure);
      this.lines.show(card.trend, structure);
    });
  }
}

function urgency({ level }) {
  return Object.keys(LEVELS).indexOf(level);
}

/** Returns the most urgent level with the sentence about all structures. `shaken` are those with a report. */
function summary(structures, shaken) {
  const { level } = structures[0] ?? { level: "learning" };
  if (structures.length === 0) return { level, text: t("no-structure-is-watched") };
  const of = structures.length === 1 ? t("1-structure") : t("many-structures", structures.length);
  // German has another form behind a preposition.
  const among = structures.length === 1 ? t("1-structure") : t("of-many-structures", structures.length);
  const at = (...levels) => structures.filter((one) => levels.includes(one.level));
  const urgent = at("alarm", "stale", "warning");
  const told = (key, of_level, ...values) => ({ level: of_level, text: t(key, LEVELS[of_level].sign, ...values) });
  if (urgent.length === 1) return told("1-of-needs-attention", level, among, urgent[0].name);
  if (urgent.length > 1) return told("of-need-attention", level, urgent.length, among, namesOrCounts(urgent));
  const inspected = shaken.filter(({ earthquake }) => INSPECTED.includes(earthquake.urgency));
  if (inspected.length > 0) return told("watched-an-inspector-is-needed", URGENCIES[inspected[0].earthquake.urgency], of, inspected.map(({ name }) => name).join(", "));
  const [seen, open] = [at("notice"), at("undecided", "learning")];
  if (seen.length > 0) return told("watched-no-new-alarm", "notice", of, namesOrCounts(seen));
  if (open.length > 0) return told("watched-no-decision-on", level, of, namesOrCounts(open));
  return { level, text: t("watched-nothing-needs-attention", of) };
}

/** Largest number of structures that the summary names. With more, it counts them by level. */
const MOST_NAMED = 8;

function namesOrCounts(structures) {
  if (structures.length <= MOST_NAMED) return structures.map(({ name }) => name).join(", ");
  const counted = Object.entries(LEVELS).map(([key, { sign, word }]) => [`${sign} ${word}`, structures.filter(({ level }) => level === key).length]);
  return counted.filter(([, count]) => count > 0).map(([text, count]) => `${text} ${count}`).join(", ");
}

/** Urgencies that ask for an inspector. */
const INSPECTED = ["inspect first", "inspect"];

/** Orders reports by their urgency, then by the loss by the newest value. */
function byUrgency(a, b) {
  const words = Object.keys(URGENCIES);
  const rank = ({ earthquake: { urgency } }) => (urgency in URGENCIES ? words.indexOf(urgency) : words.length);
  return rank(a) - rank(b) || (b.worst?.loss ?? 0) - (a.worst?.loss ?? 0) || natural(a.name, b.name);
}

/** Creates an entry of the list of reports of earthquakes. */
export function makeReported() {
  const badge = h("span", { class: "badge" });
  const link = h("a", {});
  const when = h("time");
  const result = h("p", { lang: SERVICES });
  const later = h("p", { class: "group-text", lang: SERVICES });
  return { element: h("li", {}, h("div", { class: "card-head" }, badge, link, when), result, later), badge, link, when, result, later };
}

/** Shows a report of an earthquake. `title` is the text of its link. */
export function updateReported({ element, badge, link, when, result, later: last }, { name, earthquake }, title = name) {
  const { urgency, later } = earthquake;
  const level = URGENCIES[urgency] ?? "learning";
  element.dataset.level = level;
  setText(badge, `${LEVELS[level].sign} ${urgencyWord(urgency)}`);
  link.href = report(name, earthquake.report);
  setText(link, title);
  setText(when, time(earthquake.time_s));
  setSentence(result, earthquake.result);
  last.hidden = !later;
  if (later) last.replaceChildren(h("a", { href: report(name, later.report), lang: language }, t("latest-report")), ` (${time(later.time_s)}): `, h("span", { lang: language }, urgencyWord(later.urgency)), `. ${later.result}`);
}

function urgencyWord(urgency) {
  return wordOf(urgency.replaceAll(" ", "-"));
}

function makeCard(structure) {
  const fields = {};
  const fact = (key, title) => {
    fields[key] = h("dd", {}, "–");
    return h("div", { class: `fact fact-${key}` }, h("dt", {}, title), fields[key]);
  };
  const sign = h("span", { class: "sign", "aria-hidden": "true" });
  const word = h("span", { class: "word" });
  const sentence = h("p", { class: "sentence", lang: SERVICES });
  const now = h("p", { class: "now", lang: SERVICES, hidden: true });
  const also = h("p", { class: "also", lang: SERVICES });
  const stale = h("span", { class: "badge", "data-level": "stale" });
  const seen = h("span", { class: "badge", "data-level": "notice" });
  const trend = h("canvas", { class: "trend", role: "img", hidden: true });
  const element = h(
    "li",
    { class: "card structure-card", "data-name": structure.name },
    h(
      "div",
      { class: "card-head" },
      h("span", { class: "badge" }, sign, " ", word),
      seen,
      stale,
      h("h2", {}, h("a", { href: place(structure.name) }, structure.name)),
      trend,
    ),
    h("p", { class: "description" }, [structure.description, structure.place].filter(Boolean).join(" · ")),
    sentence,
    now,
    also,
    h(
      "dl",
      { class: "facts" },
      fact("worst", t("worst-part")),
      fact("probability", t("probability-of-loss")),
      fact("sensors", t("sensors-alive")),
      fact("monitoring", t("monitoring")),
      fact("fit", t("fit")),
      fact("lag", t("lag")),
      fact("age", t("data")),
      fact("alert", t("last-alert")),
    ),
  );
  return { element, fields, sign, word, sentence, now, also, seen, stale, trend };
}

function updateCard({ element, fields, sign, word, sentence, now, also, seen, stale }, structure) {
  const level = attentionWords(structure);
  element.dataset.level = structure.level;
  setText(sign, level.sign);
  setText(word, level.word);
  setSentence(sentence, structure.sentence);
  // A row of many has one line.
  setAttribute(sentence, "title", sentence.textContent);
  showNow(now, structure);
  showAlso(also, structure);
  showAcknowledged(seen, structure);
  showStale(stale, structure);
  const { worst, last_alert: last, sensors } = structure;
  setText(fields.worst, worst ? `${worst.parameter}: ${ratio(worst.mean)}\u00a0±\u00a0${ratio(worst.std)}` : "–");
  const chance = probability(worst?.probability_of_loss, worst?.credibility);
  const asked = worst ? t("for-more-than", percent(worst.rule_loss, 0)) : "";
  setText(fields.probability, worst ? (worst.undecided ? t("not-decided", chance) : worst.unconfirmed ? t("open-state", STATES.unconfirmed.word, chance) : chance) + asked : "–");
  setText(fields.sensors, structure.ended ? t("record-has-ended") : t("share", sensors.alive, sensors.total) + troubledWords(sensors));
  fields.sensors.title = sensors.troubled.join(", ");
  // Without a filter, no part is judged within seconds.
  for (const key of ["worst", "probability", "fit"]) fields[key].parentElement.hidden = !structure.is_filtered;
  setText(fields.monitoring, structure.is_filtered ? wordOf(structure.monitoring ?? "unknown") : t("only-natural-frequencies"));
  setText(fields.fit, fitWord(structure));
  setText(fields.lag.previousElementSibling, structure.replayed ? t("origin") : t("lag"));
  setText(fields.lag, lag(structure.lag_s, structure.replayed));
  // For a record, the time is more informative than the age.
  setSentence(fields.age, structure.replayed ? t("age-measured", age(structure), time(structure.time_s)) : age(structure));
  setSentence(fields.alert, last ? t("at-time", `${STATES[last.state].sign} ${last.parameter} ${stateWords(last)}`, timeOfAlert(last, last.time_s)) : t("none"));
}

/** Returns the names of the sensors that need attention, behind the number of those that deliver. */
export function troubledWords({ troubled }) {
  const [named, further] = [troubled.slice(0, MOST_SENSORS), troubled.length - MOST_SENSORS];
  return named.length > 0 ? t("not", named.join(", ") + (further > 0 ? t("and-more", further) : "")) : "";
}

/** Shows what else needs attention while an alert is raised. */
export function showAlso(line, { also }) {
  line.hidden = !also;
  if (also) setSentence(line, also);
}

/**
 * Shows the loss by the newest value beside the sentence of an alert, which describes the time of
 * its change.
 */
export function showNow(line, { now, age_s, level }) {
  // The line comes and goes with the values. During an alarm its place remains, so that nothing moves.
  line.hidden = !now && (line.hidden || level !== "alarm");
  line.style.visibility = now ? "" : "hidden";
  if (now) setText(line, `${age_s === null || age_s > 3 ? t("by-the-last-value") : t("now")}: ${withMinus(now)}`);
}

/** Shows beside any other level that somebody has acknowledged an active alert. */
export function showAcknowledged(badge, { acknowledged, level }) {
  badge.hidden = !acknowledged || level === "notice";
  if (!badge.hidden) setText(badge, t("alerts-acknowledged", LEVELS.notice.sign, acknowledged === 1 ? t("one-alert") : t("many-alerts", acknowledged)));
}

/** Shows beside any other level that no new data arrives. */
export function showStale(badge, { age_s, level, ended }) {
  badge.hidden = level === "stale" || level === "learning" || level === "undecided" || (age_s !== null && age_s < 3);
  if (badge.hidden) return;
  badge.dataset.level = ended ? HEALTH.ended.level : "stale";
  if (ended) setText(badge, `${HEALTH.ended.sign} ${HEALTH.ended.word}`);
  else setText(badge, `${LEVELS.stale.sign} ${age_s === null ? t("badge-no-data-yet") : t("no-new-data-for", duration(age_s))}`);
}

/** Returns the age of a structure's data in words. */
export function age({ age_s, lag_s }) {
  if (age_s === null) return t("no-data-since-the-server-started");
  if (age_s < 1.5 && lag_s > LATE_S) return t("is-behind", duration(lag_s));
  return age_s < 1.5 ? t("new") : t("old", duration(age_s));
}
