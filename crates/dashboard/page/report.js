// A report of a period, to be printed: states, alerts, parameters, natural frequencies, sensors and
// events of the chosen structures.

import { WIDE, chart, rangeOf } from "./chart.js";
import { noon } from "./course.js";
import { grouped, h, setText } from "./dom.js";
import { eventWords } from "./events.js";
import { t } from "./language.js";
import { fetchLog, keyOfChange, keyOfEvent, merged, whatLogLacks } from "./log.js";
import { lateNotice, showTimes, timeIn } from "./ranges.js";
import { searchField } from "./search.js";
import { AROUND_S, COLUMNS, HEALTH, LEVELS, LISTED, NOT_STIFFNESS, NO_RULE, SERVICES, STATES, attentionWords, changedAt, conditionWords, coordinatesOf, duration, fitWord, isLasting, isUndecided, isWithoutDate, judgementWords, keyOfAlert, levelWords, modeWords, natural, notJudged, percent, probability, ratio, rememberFilters, reportOf, seenWords, setSentence, spanOf, stateOf, stateWords, time, timeOfChange, unit, wordOf } from "./words.js";

/** Number of points of each plot. It is about as wide as that many dots. */
const POINTS = 400;
/** Number of series in one request. The server allows 256. */
const SERIES_PER_REQUEST = 200;
/** Length of the period of a report without one in its address (s). */
const USUAL_S = 86400;
/** Largest number of events, and of alerts, that the report of a structure lists: the newest ones. */
const MOST_EVENTS = 300;
/** Half-width of the 95 % interval of a Gaussian, in standard deviations. */
const HALF_95 = 1.96;
/** Time before the newest data from which a period counts as the present (s). */
const PRESENT_S = 60;
/** Length of the plots of the judged quantities, up to the end of the period (s). */
const YEAR_S = 366 * 86400;
/** Rounding of a time in the address (s). */
const ROUNDING_S = 0.001;
/** Periods that a button selects (s). */
const USUAL = [[t("last-hour"), 3600], [t("last-day"), 86400], [t("last-week"), 7 * 86400], [t("last-month"), 30 * 86400]];

export class ReportPage {
  #isOpen = true;

  constructor(connection, parameters) {
    connection.listen(null);
    this.parameters = parameters;
    this.find = parameters.get("find") ?? "";
    this.wanted = (parameters.get("structures") ?? "").split(",").filter(Boolean);
    this.period = spanOf(parameters, AROUND_S);
    this.list = h("div", { class: "choices" });
    this.finder = h("div", { class: "tools" });
    this.from = h("input", { id: "report-from", required: true });
    this.to = h("input", { id: "report-to", required: true });
    this.event = h("select", { id: "report-event", onchange: () => this.#choose(Number(this.event.value) - AROUND_S, Number(this.event.value) + AROUND_S) }, h("option", { value: "" }, t("choose-an-event")));
    this.zone = h("span");
    this.told = h("p", { class: "told", role: "status" });
    this.print = h("button", { type: "button", class: "main", disabled: true, onclick: () => window.print() }, t("print-or-save-as-pdf"));
    const usual = USUAL.map(([text, length_s]) => h("button", { type: "button", onclick: () => this.#choose(this.end_s - length_s, this.end_s) }, text));
    this.usual = h("div", { class: "ranges", role: "group", "aria-label": t("period") }, usual);
    this.form = h(
      "form",
      { class: "card report-form", hidden: true, onsubmit: (event) => this.#submit(event) },
      h("fieldset", {}, h("legend", {}, t("structures")), this.finder, this.list),
      h("fieldset", {}, h("legend", {}, t("period")), this.usual, h("div", { class: "free-range" }, h("label", { for: "report-from" }, t("from")), this.from, h("label", { for: "report-to" }, t("to")), this.to, this.zone, h("button", { type: "submit" }, t("show"))), h("div", { class: "free-range" }, h("label", { for: "report-event" }, t("or-around-an-event")), this.event)),
      this.told,
      h("div", { class: "actions" }, this.print),
    );
    this.sheet = h("div", { class: "report", "data-state": "loading" }, ...empty(t("loading")));
    this.element = h("div", { class: "report-page" }, this.form, this.sheet);
    this.#load();
  }

  /** The title of the window, which is the default name of a saved file. */
  get title() {
    return t("report-title", this.wanted.join(", ")).trim();
  }

  close() {
    this.#isOpen = false;
  }

  async #load() {
    try {
      await this.#build();
    } catch (error) {
      if (!(error instanceof TypeError && /fetch/i.test(error.message))) throw error; // a mistake in the page
      this.sheet.replaceChildren(...empty(t("cannot-reach-spandrel-retrying")));
      setTimeout(() => this.#isOpen && this.#load(), 2000);
    }
  }

  async #build() {
    const [{ structures }, { changes }] = await Promise.all(["/api/structures", "/api/alerts"].map(async (address) => (await fetch(address)).json()));
    const names = structures.map(({ name }) => name).sort(natural);
    const chosen = this.wanted.filter((name) => names.includes(name));
    this.wanted = chosen.length > 0 ? chosen : names;
    const all = await Promise.all(this.wanted.map(async (name) => (await fetch(`/api/structures/${encodeURIComponent(name)}`)).json()));
    if (!this.#isOpen) return;
    const urgency = ({ overview }) => Object.keys(LEVELS).indexOf(overview.level);
    const reported = all.map((one) => ({ ...one, changes: changes.filter(({ structure }) => structure === one.about.name) })).sort((a, b) => urgency(a) - urgency(b) || natural(a.about.name, b.about.name));
    const newest = reported.map(({ overview }) => overview.time_s).filter((time) => time !== null);
    // An alert remains known if no data have come since the server was started.
    this.end_s = newest.length > 0 ? Math.max(...reported.map(endOf)) : reported.some(isKnown) ? Date.now() / 1000 : null;
    if (this.end_s === null) {
      this.sheet.dataset.state = "complete";
      return this.sheet.replaceChildren(...empty(t("no-data-yet-there-is-nothing-to")));
    }
    // A record without dates starts at 0.
    const start = (length_s) => (isWithoutDate(this.end_s) ? Math.max(0, this.end_s - length_s) : this.end_s - length_s);
    const { from_s, to_s } = this.period && !this.period.length_s ? this.period : { from_s: start(this.period?.length_s ?? USUAL_S), to_s: this.end_s };
    this.#fillForm(names, reported, from_s, to_s);
    const [series, logs, years] = await Promise.all([(one) => pointsOf(one.about, from_s, to_s), (one) => fetchLog(one.about.name, { from_s, to_s }), (one) => yearsOf(one, to_s)].map((of) => Promise.all(reported.map(of))));
    if (!this.#isOpen) return;
    const logged = reported.map((one, index) => withLog(one, logs[index]));
    this.#listEvents(logged);
    // Where less is stored, the plots start with the data.
    const firsts = series.filter(({ isLate }) => !isLate).flatMap(({ found }) => [...found.values()].map(([times]) => times[0]).filter((time) => time !== undefined));
    const shown = { from_s: firsts.length > 0 ? Math.max(from_s, Math.min(...firsts, to_s - 1)) : from_s, to_s };
    const again = () => this.#load();
    const sections = logged.map((one, index) => section(one, { ...series[index], years: years[index], again }, { from_s, to_s }, shown));
    this.sheet.replaceChildren(head(reported, { from_s, to_s }, shown), ...sections);
    this.sheet.dataset.state = "complete";
    this.print.disabled = false;
  }

  #fillForm(names, reported, from_s, to_s) {
    const choice = (name) => h("label", { class: "check" }, h("input", { type: "checkbox", value: name, checked: this.wanted.includes(name) }), name);
    const choices = names.map(choice);
    this.list.replaceChildren(...choices);
    // Only many structures need a search and buttons that check all of the found ones.
    const show = () => names.forEach((name, index) => (choices[index].hidden = !search.finds(name)));
    const changed = () => {
      this.find = search.text();
      rememberFilters("report", { ...Object.fromEntries(this.parameters), find: this.find });
      show();
    };
    const search = searchField(names.length, t("find-a-structure"), changed, this.find);
    show();
    const check = (isChecked) => choices.filter(({ hidden }) => !hidden).forEach((of) => (of.querySelector("input").checked = isChecked));
    const button = (text, isChecked) => h("button", { type: "button", class: "small", onclick: () => check(isChecked) }, text);
    if (search.element) this.finder.replaceChildren(search.element, h("span", { class: "ranges", role: "group", "aria-label": t("choose-structures") }, button(t("choose-all"), true), button(t("choose-none"), false)));
    showTimes([this.from, this.to], [from_s, to_s], this.zone);
    this.usual.hidden = isWithoutDate(to_s);
    this.form.hidden = false;
  }

  #listEvents(reported) {
    const happened = reported.flatMap(({ about, events, changes }) => eventsOf({ events }, changes).filter(({ isListed }) => isListed).map((event) => ({ ...event, structure: about.name })));
    happened.sort((a, b) => b.time_s - a.time_s);
    this.event.replaceChildren(this.event.firstElementChild, ...happened.map(({ when, measured_s, structure, about, what, lang }) => h("option", { value: measured_s, lang: lang ?? null }, `${when}: ${structure}, ${about} ${what}`)));
  }

  #submit(event) {
    event.preventDefault();
    const [from_s, to_s] = [this.from, this.to].map(timeIn);
    if (!(to_s > from_s)) return setText(this.told, t("end-after-start"));
    this.#choose(from_s, to_s);
  }

  /** Opens the report of a period as a new address. */
  #choose(from_s, to_s) {
    const names = [...this.list.querySelectorAll("input:checked")].map(({ value }) => value);
    if (names.length === 0) return setText(this.told, t("choose-at-least-one-structure"));
    location.hash = reportOf(names, { from_s, to_s, find: this.find });
  }
}

/** Returns a structure with the log of the period beside the newest changes and events, newest first. */
function withLog(one, log) {
  const changes = merged(one.changes, log.changes, keyOfChange).sort((a, b) => b.changed_ns - a.changed_ns);
  return { ...one, log, changes, events: merged(one.standing.events, log.events, keyOfEvent).sort((a, b) => b.time_ns - a.time_ns) };
}

/** Returns whether more is known of a structure than its file. */
function isKnown({ overview, standing: { alerts, judgements } }) {
  return overview.time_s !== null || alerts.length > 0 || judgements.length > 0;
}

/**
 * Returns the alerts that were active when a period began: the last change of each before it, or its present
 * state if no change is known.
 */
function activeAt(from_s, changes, { alerts, lasting_alerts: lasting }) {
  const known = new Set(changes.map(keyOfAlert));
  const all = [...changes, ...[...alerts, ...lasting].filter((alert) => !known.has(keyOfAlert(alert)))];
  const earlier = all.filter(({ changed_ns: at }) => at / 1e9 < from_s - ROUNDING_S);
  return grouped(earlier, keyOfAlert).map(([last]) => last).filter(({ state }) => LISTED.includes(state) && state !== "cleared");
}

/** Fetches the days of the judged quantities up to a time. Returns the courses by quantity, without those that judge does not supply. */
async function yearsOf({ about, standing }, to_s) {
  const courses = new Map();
  for (const { quantity } of standing.judgements) {
    const query = new URLSearchParams({ from: to_s - YEAR_S, to: to_s });
    const response = await fetch(`/api/structures/${encodeURIComponent(about.name)}/judgements/${encodeURIComponent(quantity)}/course?${query}`);
    if (!response.ok) break; // the service does not answer
    courses.set(quantity, await response.json());
  }
  return courses;
}

/** Share of a period without data from which the points are fetched again, for the rest of it. */
const MOST_EMPTY = 0.05;

/** Fetches all series of a report. Returns their columns by name, and whether the history was late. */
async function pointsOf(about, from_s, to_s) {
  const all = await fetchPoints(about, from_s, to_s);
  const { kept_from_s: kept, isLate } = all;
  // The points of a reply are spread over all of its span.
  const isMostlyEmpty = kept !== null && kept < to_s && kept - from_s > MOST_EMPTY * (to_s - from_s);
  return isMostlyEmpty && !isLate ? fetchPoints(about, kept, to_s) : all;
}

async function fetchPoints({ name, parameters, modes, conditions }, from_s, to_s) {
  const names = [...parameters.flatMap(({ name }) => [`parameter/${name}`, `loss/${name}`]), ...modes.map(({ name }) => `mode/${name}`), ...conditions.map(({ name }) => `condition/${name}`)];
  const found = new Map();
  let [kept_from_s, isLate] = [null, false];
  for (let at = 0; at < names.length; at += SERIES_PER_REQUEST) {
    const query = new URLSearchParams({ series: names.slice(at, at + SERIES_PER_REQUEST).join(","), points: POINTS, from: from_s, to: to_s });
    const response = await fetch(`/api/structures/${encodeURIComponent(name)}/history?${query}`);
    const answer = await response.json();
    if (answer.kept_from_s !== null) kept_from_s = Math.min(answer.kept_from_s, kept_from_s ?? Infinity);
    isLate ||= answer.incomplete;
    for (const { name, data } of answer.series) found.set(name, data);
  }
  return { kept_from_s, isLate, found };
}

/**
 * Returns the end of the newest period of a structure (s): the newest sample, the newest event, or the
 * present of live data. An event can have wall-clock time, which says nothing about a replayed record.
 */
function endOf({ overview: { time_s: newest, replayed }, standing, changes }) {
  if (newest === null) return -Infinity;
  const happened = eventsOf(standing, changes).map(({ measured_s: at }) => at);
  const isLive = !replayed && !isWithoutDate(newest);
  return Math.max(newest, ...(isLive ? [...happened, Date.now() / 1000] : happened.filter((at) => at <= newest + PRESENT_S)));
}

/** Returns the changes of alerts and the events, the oldest first. */
function eventsOf({ events }, changes) {
  const ofAlert = (change) => {
    const { parameter, state, changed_ns: measured, why } = change;
    const { sign, level } = STATES[state];
    return { time_s: changedAt(change), when: timeOfChange(change), measured_s: measured / 1e9, about: parameter, what: `${sign} ${stateWords(change)}`, why: [why.replace(/\.$/, ""), seenWords(change)].filter(Boolean).join(". "), level, isListed: LISTED.includes(state) };
  };
  const ofEvent = ({ kind, subject, what, why, time_ns }) => ({ time_s: time_ns / 1e9, when: time(time_ns / 1e9), measured_s: time_ns / 1e9, what, ...eventWords({ kind, subject, why }), level: "learning", isListed: true, lang: SERVICES });
  return [...changes.map(ofAlert), ...events.map(ofEvent)].sort((a, b) => a.time_s - b.time_s);
}

function table(columns, rows, { label, className = "" }) {
  // A cell is a text, or a name with a text behind it.
  const fill = (element, cell) => (typeof cell === "string" ? sentence(element, cell) : (element.append(sentence(h("strong", { lang: cell.lang ?? null }), cell.name), " ", sentence(h("span", { lang: SERVICES }), cell.text)), element));
  const row = ({ level, cells }) => h("tr", { "data-level": level }, cells.map((cell, column) => fill(column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": columns[column] }), cell)));
  return h("table", { class: `report-table ${className}`, "aria-label": label }, h("thead", {}, h("tr", {}, columns.map((text) => h("th", { scope: "col" }, text)))), h("tbody", {}, rows.map(row)));
}

function sentence(element, text) {
  setSentence(element, text);
  return element;
}

/** Returns sign and word of the level of a structure. */
function badge(overview) {
  const { sign, word } = attentionWords(overview);
  return `${sign} ${word}`;
}

/** Returns the heading of a report without contents, and the text that says why. */
function empty(text) {
  return [h("h1", {}, t("structural-health-report")), h("p", { class: "empty" }, text)];
}

/** The first page: the period, and one line per structure. */
function head(reported, { from_s, to_s }, shown) {
  const rows = reported.map(({ overview }) => ({ level: overview.level, cells: [overview.name, badge(overview), { name: "", text: overview.sentence }] }));
  const period = t("report-period", time(from_s), time(to_s), duration(to_s - from_s));
  const made = t("made-by-spandrel-on-the-states-are", time(Date.now() / 1000));
  const stored = shown.from_s > from_s + 1 ? t("data-are-stored-from-on", time(shown.from_s)) : "";
  const all = rows.length > 1 ? table([t("structure"), t("state"), t("reason")], rows, { label: t("structures"), className: "is-states" }) : null;
  return h("header", { class: "report-head" }, h("h1", {}, t("structural-health-report")), sentence(h("p", { class: "period" }), period), sentence(h("p", { class: "group-text" }), made + stored), all);
}

/** Everything about one structure. Without the replies of the history, the report has no estimates. */
function section({ about, overview, standing, changes, events: known, log }, { found, isLate, years, again }, period, shown) {
  if (!isKnown({ overview, standing })) return h("article", { class: "report-structure is-empty", "data-structure": about.name, "data-level": overview.level }, h("h2", {}, about.name), sentence(h("p", { lang: SERVICES }), overview.sentence));
  const isWithin = ({ measured_s: at }) => at >= period.from_s - ROUNDING_S && at <= period.to_s + ROUNDING_S;
  const happened = eventsOf({ events: known }, []).filter(isWithin);
  const all = eventsOf({ events: [] }, changes).filter(isWithin);
  const alerts = [...eventsOf({ events: [] }, activeAt(period.from_s, changes, standing)), ...all.filter(({ isListed }) => isListed)];
  const others = all.filter(({ isListed }) => !isListed).length;
  const where = [about.description, about.place, coordinatesOf(about.coordinates)].filter(Boolean);
  const series = isLate ? null : found;
  const { sensors } = overview;
  const facts = [overview.time_s === null ? t("no-data") : t("newest-data-at", time(overview.time_s)), overview.ended ? t("record-has-ended") : t("sensors-alive-of", sensors.alive, sensors.total), ...(overview.is_filtered ? [t("report-monitoring", wordOf(overview.monitoring ?? "unknown")), t("fit-is", fitWord(overview))] : [overview.has_model ? t("updated-from-natural-frequencies") : t("no-model-natural-frequencies-only")])];
  const help = [about.contact ? t("contact", about.contact) : "", about.runbook ? `${t("runbook")}: ${about.runbook}` : ""].filter(Boolean).join(" · ");
  const part = (title, ...content) => h("section", { class: "report-part" }, h("h3", {}, title), content);
  const none = (text) => h("p", { class: "group-text" }, text);
  // Without the history, an empty list is not known to be complete.
  const lacks = whatLogLacks(log);
  const events = (list, text) => (list.length === 0 ? (log.isRead ? none(text) : null) : table(COLUMNS.events.slice(0, 3), list.slice(-MOST_EVENTS).map(({ when, about, what, why, level, lang }) => ({ level, cells: [when, about, { name: what, text: why, lang }] })), { label: text, className: "is-events" }));
  const left = (list, lack) => [list.length > MOST_EVENTS ? t("earlier-events-not-shown", list.length - MOST_EVENTS) : "", lack].filter(Boolean).map((text) => sentence(none(text), text));
  return h(
    "article",
    { class: "report-structure", "data-structure": about.name, "data-level": overview.level },
    h("h2", {}, about.name),
    h("p", { class: "description" }, where.join(" · ")),
    h("div", { class: "report-state" }, h("span", { class: "badge" }, badge(overview)), sentence(h("p", { class: "sentence", lang: SERVICES }), overview.sentence), overview.now ? h("p", { class: "now", lang: SERVICES }, t("by-the-newest-value", overview.now)) : null, overview.also ? sentence(h("p", { class: "also", lang: SERVICES }), overview.also) : null, sentence(h("p", { class: "group-text" }), facts.join(" · ")), help ? h("p", { class: "group-text" }, help) : null),
    isLate ? lateNotice(again) : null,
    part(t("alerts-in-the-period"), events(alerts, t("no-alert")), left(alerts, lacks), others > 0 ? none(t("further-changes-between-normal-learning-and-undecided", others)) : null),
    about.parameters.length > 0 ? part(t("parameters"), parameterTable(about, overview, standing, changes, series, period), series && parameterCharts(about, standing, changes, series, shown)) : null,
    about.modes.length > 0 ? part(t("natural-frequencies"), modeList(standing), series && charts(about.modes, "mode", series, shown, ({ name }) => `${name} (Hz)`)) : null,
    about.judged.length > 0 ? part(t("lasting-change"), standing.judgements.length === 0 ? none(t("the-service-judge-has-not-reported-yet")) : [h("ul", { class: "sensor-list" }, standing.judgements.map(judgementLine)), yearCharts(standing, years, period.to_s)]) : null,
    about.conditions.length > 0 ? part(t("conditions"), h("ul", { class: "sensor-list" }, standing.conditions.map((condition) => h("li", {}, conditionWords(condition).text))), series && charts(about.conditions, "condition", series, shown, ({ name, unit: of }) => `${name} (${unit(of)})`)) : null,
    part(t("sensors-at-the-time-of-the-report"), sensorTable(about, standing)),
    part(t("events-in-the-period"), events(happened, t("no-event-is-known")), left(happened, happened.length > 0 ? "" : lacks)),
  );
}

/** Returns the state of a parameter at the end of the period, in words. */
function stateAtEnd({ name }, ruled, overview, standing, changes, { to_s }) {
  if (!ruled.has(name)) return { level: "learning", words: NO_RULE };
  const alert = standing.alerts.find(({ parameter }) => parameter === name);
  const isPresent = to_s >= overview.time_s - PRESENT_S;
  if (isPresent && alert) {
    const { sign, word, level } = stateOf(alert);
    return { level, words: `${sign} ${word}`, isOpen: isUndecided(alert) };
  }
  // The changes are sorted, the newest first.
  const last = changes.find((change) => change.parameter === name && !isLasting(change) && change.changed_ns / 1e9 <= to_s);
  return last && !isPresent ? { level: STATES[last.state].level, words: `${STATES[last.state].sign} ${STATES[last.state].word}`, isOpen: isUndecided(last) } : { level: "learning", words: t("no-decision-known") };
}

/** Without `series`, the estimates were not read. */
function parameterTable(about, overview, standing, changes, series, period) {
  const ruled = new Set(about.rules.flatMap(({ parameters }) => parameters));
  const rows = about.parameters.map((parameter) => {
    const { level, words, isOpen } = !about.is_filtered ? { level: "learning", words: notJudged(about) } : stateAtEnd(parameter, ruled, overview, standing, changes, period);
    const [, means, stds] = series?.get(`parameter/${parameter.name}`) ?? [[], [], []];
    const row = means.findLastIndex((mean) => mean !== null);
    const [mean, std] = [means[row], stds[row]];
    const chance = series?.get(`loss/${parameter.name}`)?.[4]?.at(-1);
    const loss = standing.losses[parameter.name];
    const toldOf = (text) => (isOpen ? t("not-decided", text) : text);
    const asked = loss && parameter.stiffness && chance != null ? t("probability-for-more-than", toldOf(probability(chance, loss.rule_credibility)), percent(loss.rule_loss, 0)) : parameter.stiffness ? "–" : NOT_STIFFNESS;
    const texts = row < 0 ? [series ? t("no-estimate") : t("not-read"), "–"] : [`${ratio(mean)} ± ${ratio(std)}`, t("range", ratio(mean - HALF_95 * std), ratio(mean + HALF_95 * std))];
    return { level, cells: [parameter.name, words, ...texts, asked] };
  });
  return table(COLUMNS.parts, rows, { label: t("parameters-at-the-end-of-the-period"), className: "is-parameters" });
}

/** Draws all parameters. Stiffnesses share a scale. */
function parameterCharts({ parameters }, standing, changes, series, shown) {
  const drawn = parameters.map((parameter) => {
    const columns = series.get(`parameter/${parameter.name}`) ?? [[], [], []];
    const loss = parameter.stiffness ? standing.losses[parameter.name] : null;
    const bound = loss ? { y: (1 - loss.rule_loss) * loss.reference, text: t("threshold-lost", percent(loss.rule_loss, 0)) } : null;
    return { parameter, columns, bound, own: rangeOf(columns, bound ? [bound.y] : []) };
  });
  const ranges = drawn.filter(({ parameter, own }) => parameter.stiffness && own).map(({ own }) => own);
  const shared = ranges.length > 0 ? [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))] : null;
  const figures = drawn.map(({ parameter, columns, bound, own }, index) => {
    const marks = changes.filter((change) => change.parameter === parameter.name && !isLasting(change) && LISTED.includes(change.state)).map(({ state, changed_ns: at }) => ({ x: at / 1e9, text: `${STATES[state].sign} ${STATES[state].word}`, colour: `--${STATES[state].level}` }));
    return figure(parameter.name, lastOf(columns), own && { columns, ...shown, range: parameter.stiffness ? shared : own, marks, bound, label: t("over-the-period", parameter.name) }, isAlone(index, drawn));
  });
  return h("div", {}, h("p", { class: "group-text" }, t("report-ratio-to-the-design")), h("div", { class: "charts" }, figures));
}

/** Draws series with a value now and then. */
function charts(list, kind, series, shown, title) {
  return h("div", { class: "charts" }, list.map((one, index) => {
    const [times, values, stds] = series.get(`${kind}/${one.name}`) ?? [[], []];
    const columns = [times, values, kind === "mode" ? stds : values.map(() => null)];
    const range = times.length > 0 ? rangeOf(columns) : null;
    return figure(title(one), "", range && { columns, ...shown, range, hasPoints: true, label: t("over-the-period", one.name) }, isAlone(index, list));
  }));
}

function judgementLine(judgement) {
  const { level, text } = judgementWords(judgement);
  return sentence(h("li", { lang: SERVICES, "data-level": level }), text);
}

/** Draws the days of the judged quantities over a year, or returns null without any. */
function yearCharts({ judgements }, years, to_s) {
  const shown = judgements.filter(({ quantity }) => years.get(quantity)?.rows.length > 0);
  if (shown.length === 0) return null;
  const figures = shown.map(({ quantity }, index) => {
    const { rows, kind } = years.get(quantity);
    const times = rows.map(({ day_ns: day }) => noon(day));
    const dots = rows.map(({ measured }) => measured);
    const means = rows.map(({ expectation }) => expectation?.expected ?? null);
    const stds = rows.map(({ expectation }) => (expectation ? (expectation.interval.high - expectation.interval.low) / (2 * HALF_95) : null));
    const measured = dots.filter((value) => value !== null);
    const range = rangeOf([times, means, stds], measured) ?? rangeOf([times, dots, dots.map(() => null)]);
    const { change } = rows.at(-1);
    const marks = change ? [{ x: noon(change.found_ns), text: t("found", wordOf(change.kind)), colour: "--alarm" }] : [];
    const title = kind === "frequency" ? `${quantity} (Hz)` : quantity;
    return figure(title, "", range && { columns: [times, means, stds], from_s: Math.min(times[0], to_s - 86400), to_s, range, marks, dots, label: `${title}: ${t("measured-and-expected")}` }, isAlone(index, shown));
  });
  return h("div", {}, h("p", { class: "group-text" }, t("report-year")), h("div", { class: "charts" }, figures));
}

/** Returns the last estimate of a parameter in words. */
function lastOf([, means, stds]) {
  const row = means.findLastIndex((mean) => mean !== null);
  return row < 0 ? "" : `${ratio(means[row])} ± ${ratio(stds[row])}`;
}

/** Returns whether a plot would be alone in a row of two. */
function isAlone(index, list) {
  return index === list.length - 1 && index % 2 === 0;
}

/** Creates a plot. One that is alone in its row fills it, except where each row has one plot. */
function figure(title, last, plot, isWide) {
  const drawings = () => (isWide ? [chart({ ...plot, width: WIDE }), chart(plot)] : [chart(plot)]);
  return h("figure", { class: isWide ? "is-wide" : null }, h("figcaption", {}, title, h("span", { class: "last" }, last)), plot ? drawings() : h("p", { class: "group-text" }, t("no-data-in-the-period")));
}

function modeList({ modes }) {
  if (modes.length === 0) return h("p", { class: "group-text" }, t("the-service-modes-has-not-completed-an"));
  return table(COLUMNS.modes, modes.map(modeWords), { label: t("natural-frequencies"), className: "is-modes" });
}

function sensorTable({ drawing }, { sensors }) {
  const units = new Map(drawing.sensors.map(({ channel, quantity, unit: of }) => [channel, { quantity, of }]));
  const rows = sensors.map(({ channel, node, health, level }) => {
    const { sign, word, level: attention } = HEALTH[health];
    const { quantity, of } = units.get(channel) ?? { quantity: "", of: "" };
    const [rate, , rms, peak, last] = levelWords(level, of);
    return { level: attention, cells: [channel, wordOf(quantity), node, `${sign}\u00a0${word}`, rate, rms, peak, last] };
  });
  return table([t("sensor"), t("quantity"), t("node"), t("state"), t("samples-per-second"), t("rms"), t("peak"), t("last-sample")], rows, { label: t("sensors"), className: "is-sensors" });
}
