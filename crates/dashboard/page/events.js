// The tab of the events: changes of alerts, and events of sensors, nodes and services, by time.

import { grouped, h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { NO_REPLY, fetchLog, keyOfChange, keyOfEvent, merged, whatLogLacks } from "./log.js";
import { RangeBar } from "./ranges.js";
import { samplesExport } from "./samples.js";
import { DAY_S, Span } from "./span.js";
import { AROUND_S, COLUMNS, LISTED, SERVICES, STATES, URGENCIES, capitalised, changedAt, isLasting, judged, keyOfAlert, natural, place, revisedWords, seenWords, setSentence, stateWords, time, timeOfChange, waveformsOf } from "./words.js";
import { longestRange } from "./waveforms.js";

/** Kinds of events that the list can be limited to. */
const KINDS = { all: t("all-events"), urgent: t("alerts-that-need-attention"), others: t("sensors-nodes-and-services") };

/** Lasting changes that are alerts. */
const LOSSES = ["lasting-loss", "learned-away"];
/** Number of events that are shown at first, and with each press of the button below. A phone shows few rows. */
const STEP = matchMedia("(max-width: 760px)").matches ? 50 : 200;
/** Shortest interval between two requests for the newest events (ms). */
const FETCH_EVERY_MS = 10_000;
/** Time after which a history that has not replied is asked again (ms). */
const RETRY_MS = 15_000;

function isOfKind({ isAlert, isUrgent }, kind) {
  return kind === "all" || (kind === "urgent" ? isUrgent : !isAlert);
}

export class EventsTab {
  key = "events";
  /** The tab has a span of its own. Without a range, it shows the newest events. */
  hasSpan = false;
  plots = [];
  /** The log of the span, or null before it has arrived. */
  #log = null;
  #asked = null;
  #askedAt = -Infinity;
  #most = STEP;
  /** What the list shows. */
  #told = null;
  #toldLog = null;

  constructor(page) {
    this.page = page;
    this.span = Object.assign(new Span(), { usual_s: DAY_S, length_s: DAY_S });
    this.span.onchange(() => this.#respan());
    this.ranges = new RangeBar(this.span, null, { lengths: [], key: "events", live: t("newest-events"), label: t("period") });
    this.more = h("button", { type: "button", class: "small", onclick: () => this.#showMore() });
    this.older = h("button", { type: "button", class: "small", onclick: () => this.#showOlder() }, t("older-events"));
    this.lacking = h("p", { class: "group-text", role: "status", hidden: true });
    this.rows = h("tbody");
    const option = ([value, text]) => h("option", { value }, text);
    this.shown = h("select", { "aria-label": t("shown-events"), onchange: () => this.#changed() }, Object.entries(KINDS).map(option));
    this.none = h("p", { class: "group-text" }, t("no-event-is-known"));
    const heads = h("tr", {}, COLUMNS.events.map((text) => (text ? h("th", { scope: "col" }, text) : h("td"))));
    this.table = h("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": t("events") }, h("table", { class: "events" }, h("thead", {}, heads), this.rows));
    // The list is a page of its own, which prints well.
    const reports = h("p", { class: "group-text", hidden: !page.about.earthquakes }, h("a", { href: report(page.name, "index") }, t("earthquake-reports")));
    this.element = h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", {}, t("events")), this.shown), reports, this.ranges.element, this.none, this.table, h("div", { class: "actions" }, this.more, this.older), this.lacking);
  }

  /** Fetches the log again, as after a lost connection or when the tab is opened. */
  restart() {
    this.#fetch();
  }

  draw() {
    this.ranges.update();
  }

  async #fetch() {
    const { isLive, from_s, to_s } = this.span;
    const asked = fetchLog(this.page.name, isLive ? {} : { from_s, to_s }).catch(() => NO_REPLY);
    [this.#asked, this.#askedAt] = [asked, performance.now()];
    const log = await asked;
    // A later request has another span.
    if (asked !== this.#asked) return;
    // A log that has been read contains more than one without the history.
    if (log.history !== "no-reply" || !this.#log?.isRead) this.#log = log;
    if (this.page.standing()) this.update(this.page.standing());
  }

  #respan() {
    [this.#log, this.#most] = [null, STEP];
    this.#fetch();
    this.page.changed();
    if (this.page.standing()) this.update(this.page.standing());
  }

  #showMore() {
    this.#most += STEP;
    this.update(this.page.standing());
  }

  /** Shows the time before the oldest event of the log. */
  #showOlder() {
    const to_s = this.#log.cut_at_s;
    const { isLive, from_s } = this.span;
    this.span.fix(isLive ? to_s - Math.max(this.span.newest_s - to_s, DAY_S) : from_s, to_s);
  }

  /** Returns the changes, the newest first, and the events of the span, with those of the log. */
  #known({ events, changes }) {
    const { isLive, from_s, to_s } = this.span;
    const isWithin = (at_ns) => isLive || (at_ns / 1e9 >= from_s && at_ns / 1e9 <= to_s);
    const listed = merged(changes, this.#log?.changes ?? [], keyOfChange).filter(({ changed_ns: at }) => isWithin(at)).sort((a, b) => b.changed_ns - a.changed_ns);
    const losses = listed.filter(isLasting);
    const happened = merged(events, this.#log?.events ?? [], keyOfEvent).filter(({ time_ns: at }) => isWithin(at));
    return [listed, happened.filter((event) => !losses.some((change) => isToldBy(event, change, this.page.name)))];
  }

  /** Fetches the log again if the history has not replied, or if more has happened since than a message contains. */
  #catchUp({ events, changes }) {
    if (!this.#log) return;
    const { history, cut_at_s: cut } = this.#log;
    const since = performance.now() - this.#askedAt;
    const isUnread = history === "no-reply" && since > RETRY_MS;
    // What is older than the cut cannot be in the log.
    const has = (list, key, last, at_ns) => !last || (cut !== null && at_ns / 1e9 <= cut) || list.some((one) => key(one) === key(last));
    const [event, change] = [events.at(-1), changes.at(-1)];
    const isBehind = () => this.span.isLive && history !== "no-reply" && since > FETCH_EVERY_MS && !(has(this.#log.events, keyOfEvent, event, event?.time_ns) && has(this.#log.changes, keyOfChange, change, change?.changed_ns));
    if (isUnread || isBehind()) this.#fetch();
  }

  update(standing) {
    this.#catchUp(standing);
    // A message comes twice a second, but an event is rare.
    const { isLive, from_s, to_s } = this.span;
    const told = JSON.stringify([standing.changes.map((change) => [keyOfChange(change), change.time_ns, change.acknowledged_ns, change.note, change.why]), standing.events.map(keyOfEvent), this.shown.value, this.#most, isLive || [from_s, to_s]]);
    if (told === this.#told && this.#log === this.#toldLog) return;
    [this.#told, this.#toldLog] = [told, this.#log];
    const [changes, events] = this.#known(standing);
    this.span.newest_s = Math.max(...changes.map(({ changed_ns: at }) => at / 1e9), ...events.map(({ time_ns: at }) => at / 1e9), this.span.newest_s ?? -Infinity);
    if (this.span.newest_s === -Infinity) this.span.newest_s = null;
    // The first decision of a part is no way back.
    const returned = new Set();
    const last = new Map();
    for (const change of changes.toReversed()) {
      if (![undefined, "learning"].includes(last.get(keyOfAlert(change)))) returned.add(change);
      last.set(keyOfAlert(change), change.state);
    }
    const ofAlert = ([change, ...others]) => {
      const { sign, level } = STATES[change.state];
      const word = stateWords(change);
      const about = [change, ...others].map(({ parameter }) => parameter).sort(natural).join(", ");
      const what = change.state !== "normal" ? t("alert-became", sign, word) : returned.has(change) ? t("back-to-normal", sign) : `${sign} ${word}`;
      const more = [seenWords(change), revisedWords(change)].filter(Boolean).join(". ");
      return { key: `${change.kind}/${about}/${change.state}/${change.changed_ns}`, time_ns: 1e9 * changedAt(change), when: timeOfChange(change), measured_ns: change.changed_ns, about, what, more, why: change.why.replaceAll(change.parameter, about), level, parameter: change.parameter, isLasting: isLasting(change), isAlert: true, isUrgent: LISTED.includes(change.state) };
    };
    const ofEvent = ({ time_ns, kind, subject, what, why }) => {
      const isReport = kind === "earthquake-report";
      const level = (isReport && URGENCIES[what.split(": ")[1]]) || "learning";
      return { key: `${subject}/${what}`, time_ns, when: time(time_ns / 1e9), what, ...eventWords({ kind, subject, why }), level, parameter: null, report: isReport ? subject : null };
    };
    // A sensor that fails makes many parts undecided at once, for the same reason.
    const reason = ({ kind, parameter, state, changed_ns: at, why }) => (state === "undecided" ? `${Math.floor(at / 1e9)} ${why.replaceAll(parameter, "")}` : `${at} ${kind} ${parameter} ${state}`);
    const together = grouped(changes, reason);
    const all = [...together.map(ofAlert), ...events.map(ofEvent)].sort((a, b) => b.time_ns - a.time_ns);
    const found = all.filter((event) => isOfKind(event, this.shown.value));
    const shown = found.slice(0, this.#most);
    this.#tell(all.length, found.length);
    this.table.hidden = shown.length === 0;
    keyed(this.rows, shown, ({ key, time_ns }) => `${time_ns}/${key}`, (event) => this.#make(event), ({ why, more }, event) => {
      setSentence(why, event.why);
      setText(more, event.more ?? "");
      more.hidden = !event.more;
    });
  }

  /** Says what is not shown, and why. Only a list that the history has completed can be empty. */
  #tell(all, found) {
    const log = this.#log;
    this.none.hidden = found > 0;
    setText(this.none, log === null ? t("loading") : all > 0 ? t("no-event-of-this-kind") : log.isRead ? t("no-event-is-known") : t("no-event-read"));
    this.more.hidden = found <= this.#most;
    const left = Math.max(found - this.#most, 0);
    setText(this.more, t("show-more-events", Math.min(STEP, left), left));
    this.older.hidden = log === null || log.cut_at_s === null;
    // Without a period, the newest events are complete without the history.
    const lacks = log === null || (log.history === "absent" && this.span.isLive && found > 0) ? "" : whatLogLacks(log);
    this.lacking.hidden = lacks === "";
    setSentence(this.lacking, lacks);
  }

  /** What only this tab states in the address. */
  get query() {
    return this.shown.value === "all" ? {} : { show: this.shown.value };
  }

  goto(_, parameters) {
    this.shown.value = Object.hasOwn(KINDS, parameters.get("show")) ? parameters.get("show") : "all";
    if (this.page.standing()) this.update(this.page.standing());
  }

  #changed() {
    this.update(this.page.standing());
    this.page.changed();
  }

  #make({ time_ns, when, measured_ns: measured, about, what, level, parameter, isLasting: isOfYear, report: made }) {
    // The plots and the samples have the measurement time, also of an acknowledgement.
    const at = (measured ?? time_ns) / 1e9;
    const [why, more] = [h("p", { class: "why", lang: SERVICES }), h("p", { class: "why" })];
    const read = made ? h("a", { class: "button small", href: report(this.page.name, made) }, t("report")) : null;
    const { about: structure, name: of } = this.page;
    const sensors = structure.distributed ? [] : (structure.drawing?.sensors ?? []);
    // Of many sensors, the server reads the samples of a shorter time at once.
    const half_s = sensors.length > 0 ? Math.min(AROUND_S, 0.499 * longestRange(structure)) : AROUND_S;
    const around = () => [at - half_s, at + half_s];
    const waveforms = sensors.length > 0 ? waveformsOf(of, ...around(), sensors.some(({ channel }) => channel === about) ? about : null) : null;
    // An alert is about a parameter or a year, other events are about the motion.
    const target = isOfYear ? judged(of, parameter) : parameter || !waveforms ? place(of, parameter ?? structure.parameters[0]?.name, at) : waveforms;
    const show = h("a", { class: "button small", href: target, "aria-label": t("show-at", about, time(at)) }, t("show"));
    const motion = parameter && waveforms ? h("a", { class: "to-waveforms", href: waveforms, "aria-label": t("waveforms-at", about, time(at)) }, t("waveforms")) : null;
    // The samples of sensors with their own filters stay at their nodes.
    const samples = structure.distributed ? null : h("details", { class: "samples-of" }, h("summary", {}, t("samples")), samplesExport(of, around, `${about}, ${time(at)}`), motion);
    const name = h("strong", { lang: parameter ? null : SERVICES });
    setText(name, parameter ? what : capitalised(what));
    return { element: h("tr", { "data-level": level }, h("td", { class: "number" }, h("time", {}, when)), h("td", {}, about), h("td", {}, name, why, more), h("td", {}, h("div", { class: "row-actions" }, h("div", { class: "buttons" }, read, show), samples))), why, more };
  }
}

/**
 * Returns whether the event of a lasting loss or of its acknowledgement says the same as a change of the loss.
 * A loss that was found on a day is published on the day after it, or later after an outage.
 */
function isToldBy({ kind, subject, what, why, time_ns: at }, change, structure) {
  const { parameter, state, found_ns: found, acknowledged_by: who, note } = change;
  if (kind === "lasting-change") {
    const day = (ns) => Math.floor(ns / 1e9 / DAY_S);
    return subject === parameter && state !== "cleared" && LOSSES.includes(what) && (day(at) === day(found) + 1 || why.startsWith(change.why));
  }
  const isSeen = kind === "annotation" && /(?:^|: )acknowledged$/.test(what);
  return isSeen && state === "acknowledged" && [parameter, structure].includes(subject) && why === `${who}: ${note}`;
}

/**
 * Returns what an event is about, and its reason. The subject of an earthquake is the name of a report,
 * and that of the monitoring is a state. A link leads to the report, so the sentence needs no address.
 */
export function eventWords({ kind, subject, why }) {
  const about = kind.startsWith("earthquake") ? t("earthquake") : kind === "monitoring" ? t("monitoring") : subject;
  return { about, why: why.replace(/:? ?\/events\/\S+\.html$/, "") };
}

/** Returns the address of a report of an earthquake, or of the list of all. */
export function report(structure, name) {
  return `/events/${encodeURIComponent(structure)}/${encodeURIComponent(name)}.html`;
}
