// Alerts of all structures: current alerts, past changes and acknowledgements.

import { grouped, h, keyed, setAttribute, setText, unbroken } from "./dom.js";
import { t } from "./language.js";
import { SERVICES, STATES, canBeSeen, isLasting, judged, keyOfAlert, natural, place, rememberFilters, revisedWords, seenWords, setSentence, stateOf, time, timeOfChange, whenWords, withMinus, wordOf } from "./words.js";

/** Key of the last entered name in local storage, the default for the next acknowledgement or note. */
export const NAME_KEY = "spandrel-name";
/** Time limit for the alert service to confirm an acknowledgement (ms). */
const ANSWER_WITHIN_MS = 6000;
/** Interval at which the list is fetched (ms). A raised alert fetches it immediately. */
const ASK_EVERY_MS = 2000;
/** Largest number of past changes that are shown. */
const MOST_CHANGES = 200;
/** A telephone number in a contact, with at least seven digits. */
const TELEPHONE = /\+?\d(?:[ ()/-]*\d){6,}/;

export class AlertsPage {
  constructor(connection, parameters) {
    this.dialog = new AcknowledgeDialog(() => this.#ask());
    this.structure = h("select", { id: "filter-structure", onchange: () => this.#filter() }, h("option", { value: "" }, t("all-structures")));
    this.state = h("select", { id: "filter-state", onchange: () => this.#filter() }, h("option", { value: "" }, t("all-states")), ["raised", "unconfirmed", "pending", "softening-in-motion", "acknowledged", "cleared", "undecided", "normal", "learning"].map((state) => h("option", { value: state }, STATES[state].word)));
    this.text = h("input", { id: "filter-text", type: "search", placeholder: t("part-or-words"), oninput: () => this.#filter() });
    const field = (input, text) => h("label", { for: input.id }, text, " ", input);
    this.standing = new AlertList("alerts", true, this.dialog);
    this.changes = new AlertList("alerts past", false, this.dialog);
    this.none = h("p", { class: "empty" }, t("loading"));
    this.noChanges = h("p", { class: "empty" });
    this.left = h("p", { class: "group-text", hidden: true });
    this.element = h(
      "div",
      { class: "alerts-page" },
      h("h1", {}, t("alerts")),
      h("form", { class: "filter", onsubmit: (event) => event.preventDefault() }, field(this.structure, t("structure")), field(this.state, t("state")), field(this.text, t("contains"))),
      h("h2", {}, t("now")),
      this.none,
      this.standing.elements,
      h("h2", {}, t("history")),
      this.noChanges,
      this.changes.elements,
      this.left,
      this.dialog.element,
    );
    this.wanted = parameters.get("structure") ?? "";
    this.state.value = Object.hasOwn(STATES, parameters.get("state")) ? parameters.get("state") : "";
    this.text.value = parameters.get("text") ?? "";
    connection.listen(null);
    this.timer = setInterval(() => document.hidden || this.#ask(), ASK_EVERY_MS);
    this.#ask();
  }

  close() {
    clearInterval(this.timer);
  }

  /** Shows what the filters ask for, and keeps them in the address. */
  #filter() {
    rememberFilters("alerts", { structure: this.structure.value, state: this.state.value, text: this.text.value });
    this.#show();
  }

  async #ask() {
    try {
      const response = await fetch("/api/alerts");
      if (!response.ok) return;
      this.answer = await response.json();
    } catch {
      return; // the line at the top reports the lost connection
    }
    const known = [...new Set(this.answer.standing.map((alert) => alert.structure))];
    for (const name of known) {
      if (![...this.structure.options].some((option) => option.value === name)) this.structure.append(h("option", { value: name }, name));
    }
    if (this.wanted) [this.structure.value, this.wanted] = [this.wanted, ""];
    this.#show();
    this.dialog.update(this.answer.standing);
  }

  #show() {
    if (!this.answer) return;
    const order = ["raised", "unconfirmed", "pending", "softening-in-motion", "acknowledged", "cleared", "undecided", "learning", "normal"];
    const isAsked = (alert) =>
      (!this.structure.value || alert.structure === this.structure.value) &&
      (!this.state.value || alert.state === this.state.value) &&
      (!this.text.value || `${alert.parameter} ${alert.why} ${alert.acknowledged_by ?? ""} ${alert.note ?? ""}`.toLowerCase().includes(this.text.value.toLowerCase()));
    const raised = (alert) => this.answer.changes.find((change) => change.state === "raised" && keyOfAlert(change) === keyOfAlert(alert));
    // A lasting loss keeps the day on which it was found.
    const withRaised = (alert) => ({ ...alert, raised_ns: isLasting(alert) ? alert.changed_ns : raised(alert)?.changed_ns });
    const standing = this.answer.standing.filter(isAsked).map(withRaised).sort((a, b) => order.indexOf(a.state) - order.indexOf(b.state) || b.changed_ns - a.changed_ns || natural(a.parameter, b.parameter));
    // The last change of an alert is the alert above.
    const withState = (alert) => `${keyOfAlert(alert)}/${alert.state}`;
    const states = new Set(this.answer.standing.map(withState));
    const shownAbove = new Set(grouped(this.answer.changes, keyOfAlert).map(([newest]) => newest).filter((change) => states.has(withState(change))));
    const all = this.answer.changes.filter((change) => isAsked(change) && !shownAbove.has(change));
    const changes = all.slice(0, MOST_CHANGES);
    this.left.hidden = all.length <= MOST_CHANGES;
    setText(this.left, t("older-changes-not-shown", all.length - changes.length));
    const isFiltered = Boolean(this.structure.value || this.state.value || this.text.value);
    const hasAlert = this.standing.show(standing, keyOfAlert, isFiltered);
    const hasChange = this.changes.show(changes, (alert) => `${keyOfAlert(alert)}/${alert.changed_ns}/${alert.state}`, isFiltered);
    this.none.hidden = hasAlert;
    setText(this.none, isFiltered ? t("no-alert-matches-the-filter") : standing.length > 0 ? t("no-alert") : t("no-rule-has-reached-a-decision-yet"));
    this.noChanges.hidden = hasChange;
    setText(this.noChanges, isFiltered ? t("no-change-matches-the-filter") : t("no-changes"));
  }
}

/** States of an alert that need nobody. */
export const ROUTINE = ["normal", "learning", "undecided"];

/** A list of alerts or changes. Routine ones are folded away, unless a filter asks for them. */
class AlertList {
  constructor(className, canAcknowledge, dialog) {
    this.canAcknowledge = canAcknowledge;
    this.dialog = dialog;
    this.urgent = h("ul", { class: className });
    this.routine = h("ul", { class: className });
    this.title = h("summary");
    this.folded = h("details", { class: "routine", hidden: true }, this.title, this.routine);
  }

  get elements() {
    return [this.urgent, this.folded];
  }

  /** Shows the alerts, and returns whether any of them is not folded away. */
  show(alerts, key, isFiltered) {
    const isUrgent = ({ state }) => isFiltered || !ROUTINE.includes(state);
    const [urgent, routine] = [alerts.filter(isUrgent), alerts.filter((alert) => !isUrgent(alert))];
    // Current alerts have one card per part. Past changes of a part are folded behind the newest.
    if (this.canAcknowledge) keyed(this.urgent, urgent, key, () => this.#make(), updateAlert);
    else keyed(this.urgent, grouped(urgent, keyOfAlert), ([newest]) => keyOfAlert(newest), () => this.#makeGroup(), (group, changes) => this.#updateGroup(group, changes, key));
    keyed(this.routine, routine, key, () => this.#make(), updateAlert);
    this.folded.hidden = routine.length === 0;
    setText(this.title, this.canAcknowledge ? t("parts-without-an-alert", routine.length) : t("changes-between-normal-learning-and-undecided", routine.length));
    return urgent.length > 0;
  }

  #makeGroup() {
    const newest = this.#make();
    const [title, list] = [h("summary"), h("ul", { class: "alerts past" })];
    const folded = h("details", { class: "routine" }, title, list);
    newest.element.append(folded);
    return { ...newest, newest, title, list, folded };
  }

  #updateGroup({ newest, title, list, folded }, changes, key) {
    updateAlert(newest, changes[0]);
    const first = changes.at(-1);
    folded.hidden = changes.length === 1;
    const [word, since] = [STATES[first.state].word, timeOfChange(first)];
    setText(title, changes.length === 2 ? t("changed-once", word, since) : t("changed-times", word, since, changes.length - 1));
    keyed(list, changes.slice(1), key, () => this.#make(), updateAlert);
  }

  #make() {
    const parts = { badge: h("span", { class: "badge" }), who: h("a", { class: "who" }), why: h("p", { class: "sentence", lang: SERVICES }), now: h("p", { class: "now", lang: SERVICES }), seen: h("p", { class: "seen" }), revised: h("p", { class: "seen" }), when: h("span", { class: "when" }), link: h("a", { class: "button small" }), help: makeHelp() };
    parts.button = this.canAcknowledge ? h("button", { type: "button", class: "acknowledge", onclick: () => this.dialog.open(parts.alert) }) : null;
    parts.element = h("li", { class: "card alert" }, h("div", { class: "card-head" }, parts.badge, parts.who, parts.when), parts.why, parts.now, parts.seen, parts.revised, parts.help.element, h("div", { class: "actions" }, parts.button, parts.link));
    return parts;
  }
}

/** Creates the lines that say whom to call about an alert, and who was notified. */
export function makeHelp() {
  const parts = { contact: h("span"), between: h("span", {}, " · "), runbook: h("a", { rel: "noreferrer" }, t("runbook")), sent: h("p"), failed: h("p", { "data-level": "warning" }) };
  parts.call = h("p", { class: "call" }, parts.contact, parts.between, parts.runbook);
  parts.element = h("div", { class: "help" }, parts.call, parts.sent, parts.failed);
  return parts;
}

/** Shows whom to call about the alerts of a structure, and the last notice to each receiver. */
export function updateHelp(parts, alerts) {
  const needed = alerts.filter(({ state }) => !ROUTINE.includes(state));
  const { contact, runbook } = needed[0] ?? {};
  parts.call.hidden = !contact && !runbook;
  showContact(parts.contact, contact ? t("contact", contact) : "");
  parts.runbook.hidden = !runbook;
  parts.between.hidden = !contact || !runbook;
  setAttribute(parts.runbook, "href", runbook ?? null);
  const notices = grouped(needed.flatMap(({ notices }) => notices ?? []).sort((a, b) => b.time_ns - a.time_ns), ({ receiver }) => receiver).map(([newest]) => newest);
  const show = (element, some, sentence) => {
    element.hidden = some.length === 0;
    const words = some.map(({ receiver, time_ns, failure }) => `${receiver} (${time(time_ns / 1e9)}${failure ? `: ${failure}` : ""})`);
    setSentence(element, sentence(words.join(", ")));
  };
  show(parts.sent, notices.filter(({ failure }) => failure === null), (receivers) => t("notified", receivers));
  show(parts.failed, notices.filter(({ failure }) => failure !== null), (receivers) => t("not-notified", receivers));
  parts.element.hidden = [parts.call, parts.sent, parts.failed].every(({ hidden }) => hidden);
}

/** Shows a contact. Its telephone number is a link, so that a phone can dial it. */
function showContact(element, text) {
  if (element.textContent === text) return;
  const { 0: number, index } = TELEPHONE.exec(text) ?? { 0: "", index: text.length };
  const link = number ? h("a", { href: `tel:${number.replaceAll(/[^+\d]/g, "")}` }, number) : "";
  element.replaceChildren(text.slice(0, index), link, text.slice(index + number.length));
}

/** Shows what the button of an alert does. An alert that is over is no alarm. */
export function labelButton(button, { state }, text = t("acknowledge"), textOfCleared = t("mark-as-seen")) {
  button.classList.toggle("is-over", state === "cleared");
  setText(button, state === "cleared" ? textOfCleared : text);
}

/** Shows that a part is normal by its newest loss, whose words are those of the services. */
function showNormal(element, { parameter, now }) {
  const told = `${parameter} ${now}`;
  if (element.told === told) return;
  const loss = h("span");
  setSentence(loss, now);
  loss.lang = SERVICES;
  element.replaceChildren(...unbroken(t("is-normal-by-the-newest-value", parameter)), loss);
  element.told = told;
}

function updateAlert(parts, alert) {
  const state = stateOf(alert);
  parts.alert = alert;
  parts.element.dataset.level = state.level;
  parts.element.dataset.state = alert.state;
  const stale = isLasting(alert) ? t("stale-the-service-judge-is-gone") : t("stale-the-alert-service-is-gone");
  setText(parts.badge, `${state.sign} ${state.word}${alert.stale ? stale : ""}`);
  setText(parts.who, `${alert.structure} / ${alert.parameter}${isLasting(alert) ? ` (${wordOf(alert.kind)})` : ""}`);
  parts.who.href = place(alert.structure);
  // The sentence of a normal parameter is as old as its first decision.
  const isNormal = alert.state === "normal" && alert.now;
  setAttribute(parts.why, "lang", isNormal ? null : SERVICES);
  if (isNormal) showNormal(parts.why, alert);
  else setSentence(parts.why, alert.why);
  parts.now.hidden = !alert.now || isNormal;
  setText(parts.now, alert.now ? t("by-the-newest-value", withMinus(alert.now)) : "");
  setSentence(parts.when, whenWords(alert));
  for (const [line, text] of [[parts.seen, seenWords(alert)], [parts.revised, revisedWords(alert)]]) {
    setText(line, text);
    line.hidden = !text;
  }
  updateHelp(parts.help, [alert]);
  // Days show a lasting loss, and moments do not.
  setText(parts.link, isLasting(alert) ? t("show-the-year") : t("show-the-moment"));
  parts.link.href = isLasting(alert) ? judged(alert.structure, alert.parameter) : place(alert.structure, alert.parameter, (alert.since_ns ?? alert.changed_ns) / 1e9);
  parts.link.parentElement.hidden = ROUTINE.includes(alert.state);
  if (!parts.button) return;
  parts.button.hidden = !canBeSeen(alert);
  labelButton(parts.button, alert);
}

/**
 * Dialog for acknowledging an alert. It sends the name and waits for the alert service to confirm, or
 * for judge if the alert is a lasting loss.
 */
export class AcknowledgeDialog {
  constructor(sent = () => {}) {
    this.sent = sent;
    this.title = h("h2");
    this.why = h("p", { class: "sentence", lang: SERVICES });
    this.who = h("input", { id: "who", name: "who", required: true, maxlength: 100, autocomplete: "name" });
    this.note = h("textarea", { id: "note", name: "note", rows: 3, maxlength: 1000 });
    this.told = h("p", { class: "told", role: "status" });
    this.send = h("button", { type: "submit", class: "acknowledge" });
    this.element = h(
      "dialog",
      { "aria-label": t("acknowledge-an-alert") },
      h(
        "form",
        { method: "dialog", onsubmit: (event) => this.#submit(event) },
        this.title,
        this.why,
        h("label", { for: "who" }, t("your-name")),
        this.who,
        h("label", { for: "note" }, t("note-optional")),
        this.note,
        this.told,
        h("div", { class: "actions" }, this.send, h("button", { type: "button", onclick: () => this.element.close() }, t("cancel"))),
      ),
    );
  }

  open(alert) {
    this.alert = alert;
    labelButton(this.send, alert);
    setText(this.title, t("acknowledge-part-of", alert.structure, alert.parameter));
    setSentence(this.why, alert.why);
    setText(this.told, t("others-will-see-that-the-alert-is"));
    this.who.value = localStorage.getItem(NAME_KEY) ?? "";
    this.note.value = "";
    this.send.disabled = false;
    this.waiting = false;
    this.element.showModal();
    (this.who.value ? this.note : this.who).focus();
  }

  /** Closes the dialog as soon as the alert service has confirmed the acknowledgement. */
  update(alerts) {
    if (!this.waiting) return;
    const own = alerts.find((alert) => keyOfAlert(alert) === keyOfAlert(this.alert));
    if (own && (own.state !== this.alert.state || own.acknowledged_by !== this.alert.acknowledged_by)) {
      this.waiting = false;
      clearTimeout(this.timer);
      this.element.close();
    }
  }

  async #submit(event) {
    event.preventDefault();
    const [who, note] = [this.who.value.trim(), this.note.value.trim()];
    if (!who) return setText(this.told, t("please-enter-your-name"));
    localStorage.setItem(NAME_KEY, who);
    this.send.disabled = true;
    setText(this.told, t("sending"));
    const { structure, parameter } = this.alert;
    const list = isLasting(this.alert) ? "judgements" : "alerts";
    const address = `/api/structures/${encodeURIComponent(structure)}/${list}/${encodeURIComponent(parameter)}/acknowledge`;
    try {
      const response = await fetch(address, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ who, note }) });
      if (!response.ok) {
        const { error, allowed } = await response.json();
        return this.#failed(`${error}; ${allowed}`);
      }
      if (response.status === 200) { // the service has accepted it
        this.element.close();
        return this.sent();
      }
      if (isLasting(this.alert)) return this.#failed(t("the-note-is-not-confirmed"));
    } catch {
      return this.#failed(t("cannot-reach-spandrel-the-acknowledgement-was-not"));
    }
    this.waiting = true;
    setText(this.told, t("sent-waiting-for-the-alert-service"));
    this.timer = setTimeout(() => this.#failed(t("no-reply-from-the-alert-service-is")), ANSWER_WITHIN_MS);
    this.sent();
  }

  #failed(text) {
    this.waiting = false;
    this.send.disabled = false;
    setText(this.told, `▲ ${text}`);
  }
}
