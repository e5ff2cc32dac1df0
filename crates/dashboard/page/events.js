// The tab of the events: changes of alerts, and events of sensors, nodes and services, by time.

import { grouped, h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { samplesExport } from "./samples.js";
import { AROUND_S, COLUMNS, LISTED, SERVICES, STATES, URGENCIES, capitalised, changedAt, natural, place, revisedWords, seenWords, setSentence, time } from "./words.js";

/** Kinds of events that the list can be limited to. */
const KINDS = { all: t("all-events"), urgent: t("alerts-that-need-attention"), others: t("sensors-nodes-and-services") };

function isOfKind({ isAlert, isUrgent }, kind) {
  return kind === "all" || (kind === "urgent" ? isUrgent : !isAlert);
}

export class EventsTab {
  key = "events";
  hasSpan = false;
  plots = [];

  constructor(page) {
    this.page = page;
    this.rows = h("tbody");
    const option = ([value, text]) => h("option", { value }, text);
    this.shown = h("select", { "aria-label": t("shown-events"), onchange: () => this.#changed() }, Object.entries(KINDS).map(option));
    this.none = h("p", { class: "group-text" }, t("no-event-is-known"));
    const heads = h("tr", {}, COLUMNS.events.map((text) => (text ? h("th", { scope: "col" }, text) : h("td"))));
    this.table = h("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": t("events") }, h("table", { class: "events" }, h("thead", {}, heads), this.rows));
    // The list is a page of its own, which prints well.
    const reports = h("p", { class: "group-text", hidden: !page.about.earthquakes }, h("a", { href: report(page.name, "index") }, t("earthquake-reports")));
    this.element = h("section", { class: "card" }, h("div", { class: "card-head" }, h("h2", {}, t("events")), this.shown), reports, this.none, this.table);
  }

  update({ events, changes }) {
    const ofAlert = ([change, ...others]) => {
      const { sign, word, level } = STATES[change.state];
      const about = [change, ...others].map(({ parameter }) => parameter).sort(natural).join(", ");
      const what = change.state === "normal" ? t("back-to-normal", sign) : t("alert-became", sign, word);
      const more = [seenWords(change), revisedWords(change)].filter(Boolean).join(". ");
      return { key: `${about}/${change.state}`, time_ns: 1e9 * changedAt(change), measured_ns: change.changed_ns, about, what, more, why: change.why.replaceAll(change.parameter, about), level, parameter: change.parameter, isAlert: true, isUrgent: LISTED.includes(change.state) };
    };
    const ofEvent = ({ time_ns, kind, subject, what, why }) => {
      const isReport = kind === "earthquake-report";
      const level = (isReport && URGENCIES[what.split(": ")[1]]) || "learning";
      return { key: `${subject}/${what}`, time_ns, what, ...eventWords({ kind, subject, why }), level, parameter: null, report: isReport ? subject : null };
    };
    // A sensor that fails makes many parts undecided at once, for the same reason.
    const reason = ({ parameter, state, changed_ns: at, why }) => (state === "undecided" ? `${Math.floor(at / 1e9)} ${why.replaceAll(parameter, "")}` : `${at} ${parameter} ${state}`);
    const together = grouped(changes, reason);
    const all = [...together.map(ofAlert), ...events.map(ofEvent)].sort((a, b) => b.time_ns - a.time_ns);
    const shown = all.filter((event) => isOfKind(event, this.shown.value));
    this.none.hidden = shown.length > 0;
    setText(this.none, all.length > 0 ? t("no-event-of-this-kind") : t("no-event-is-known"));
    this.table.hidden = shown.length === 0;
    keyed(this.rows, shown, ({ key, time_ns }) => `${time_ns}/${key}`, (event) => this.#make(event), ({ why, more }, event) => {
      setSentence(why, event.why);
      setText(more, event.more ?? "");
      more.hidden = !event.more;
    });
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

  #make({ time_ns, measured_ns: measured, about, what, level, parameter, report: made }) {
    // The plots and the samples have the measurement time, also of an acknowledgement.
    const at = (measured ?? time_ns) / 1e9;
    const [why, more] = [h("p", { class: "why", lang: SERVICES }), h("p", { class: "why" })];
    const read = made ? h("a", { class: "button small", href: report(this.page.name, made) }, t("report")) : null;
    const show = h("a", { class: "button small", href: place(this.page.name, parameter ?? this.page.about.parameters[0]?.name, at), "aria-label": t("show-at", about, time(at)) }, t("show"));
    const around = () => [at - AROUND_S, at + AROUND_S];
    const samples = h("details", { class: "samples-of" }, h("summary", {}, t("samples")), samplesExport(this.page.name, around, `${about}, ${time(at)}`));
    const name = h("strong", { lang: parameter ? null : SERVICES });
    setText(name, parameter ? what : capitalised(what));
    return { element: h("tr", { "data-level": level }, h("td", { class: "number" }, h("time", {}, time(time_ns / 1e9))), h("td", {}, about), h("td", {}, name, why, more), h("td", {}, h("div", { class: "buttons" }, read, show), samples)), why, more };
  }
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
