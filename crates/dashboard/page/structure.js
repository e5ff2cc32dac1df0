// One structure: why it needs attention, and tabs with its parts, sensors, events and settings.

import { AcknowledgeDialog, labelButton, makeHelp, updateHelp } from "./alerts.js";
import { CompareTab } from "./compare.js";
import { dateOf } from "./course.js";
import { h, keyed, setText } from "./dom.js";
import { EventsTab } from "./events.js";
import { t } from "./language.js";
import { LastingTab } from "./lasting.js";
import { ModelTab } from "./model.js";
import { NowTab } from "./now.js";
import { age, makeReported, showAcknowledged, showAlso, showNow, showStale, troubledWords, updateReported } from "./overview.js";
import { ParametersTab } from "./parameters.js";
import { RangeBar } from "./ranges.js";
import { samplesExport } from "./samples.js";
import { SensorsTab } from "./sensors.js";
import { SettingsTab } from "./settings.js";
import { DAY_S, Points, Scale, Span } from "./span.js";
import { Tabs } from "./tabs.js";
import { AROUND_S, SERVICES, TABS, addressOf, attentionWords, bySeverity, canBeSeen, duration, fitWord, isLasting, keyOfAlert, lag, place, reportOf, sensorsOf, setSentence, spanOf, time, wordOf } from "./words.js";

/** Interval at which the plots are drawn (ms), independent of the rate of the points. */
const DRAW_EVERY_MS = 250;
/** Number of alerts whose buttons are always shown. */
const MOST_BUTTONS = 2;
/** States of an alert whose figures are those of its time. An unconfirmed one can have older figures. */
const DATED = ["raised", "acknowledged"];
const PRINT = ["beforeprint", "afterprint"];

/** Returns the alerts of the rules and the lasting losses. */
const alertsOf = ({ alerts, lasting_alerts: lasting }) => [...alerts, ...lasting];

export class StructurePage {
  #standing = null;
  #isOpen = true;
  /** Address of what is shown. */
  #shown = null;
  #leave = [];
  /** Whether the details were unfolded before a print. Null without one. */
  #wasOpen = null;

  constructor(connection, name, tab, parameters) {
    this.name = name;
    this.tab = tab in TABS ? tab : "now";
    this.span = new Span();
    this.points = new Points(name, this.span);
    this.scale = new Scale();
    this.head = h("div", { class: "attention" });
    /** Name of the tab, which a print shows behind the name of the structure. */
    this.printed = h("span", { class: "printed" });
    this.paper = h("p", { class: "printed description" });
    this.body = h("div", {}, h("p", { class: "empty" }, t("loading")));
    this.element = h("div", { class: "structure" }, h("h1", {}, h("span", { class: "way" }, h("a", { class: "crumb", href: "#/" }, t("structures")), " / "), name, this.printed), this.paper, this.head, this.body);
    this.dialog = new AcknowledgeDialog();
    this.#leave = [
      connection.on("structure", ({ standing }) => this.#show(standing)),
      connection.on("points", ({ series }) => this.#take(series)),
      // Fetches points that were published while disconnected or by an earlier run of the server.
      connection.on("opened", () => this.#respan()),
      connection.on("overview", ({ structures }) => structures.filter((structure) => structure.name === name).forEach((own) => this.#attend(own))),
    ];
    this.connection = connection;
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.recolour = () => this.tabs?.forEach((of) => of.plots.forEach((plot) => plot.recolour()));
    this.scheme.addEventListener("change", this.recolour);
    this.print = ({ type }) => {
      const isOnPaper = type === "beforeprint";
      this.#current?.plots.forEach((plot) => plot.print(isOnPaper));
      if (isOnPaper) this.#unfold();
      else this.#restoreFold();
    };
    for (const event of PRINT) addEventListener(event, this.print);
    this.timer = setInterval(() => this.#draw(), DRAW_EVERY_MS);
    this.span.onchange(() => this.#respan());
    this.#load(parameters);
  }

  close() {
    this.#isOpen = false;
    this.connection.want(false);
    this.#leave.forEach((leave) => leave());
    clearInterval(this.timer);
    this.scheme.removeEventListener("change", this.recolour);
    for (const event of PRINT) removeEventListener(event, this.print);
    this.tabs?.forEach((tab) => tab.plots.forEach((plot) => plot.close()));
  }

  /** Shows another tab, moment or parameter of the same structure. */
  takes([kind, name, tab], parameters) {
    if (kind !== "structure" || name !== this.name || !this.about) return false;
    this.#goto(tab, parameters);
    return true;
  }

  get #current() {
    return this.tabs?.find(({ key }) => key === this.tab);
  }

  async #load(parameters) {
    try {
      const response = await fetch(`/api/structures/${encodeURIComponent(this.name)}`);
      const answer = await response.json();
      if (!response.ok) {
        this.connection.listen(null);
        this.body.replaceChildren(h("p", { class: "empty" }, `${answer.error}; ${answer.allowed}. `, h("a", { href: "#/" }, t("link-all-structures"))));
        return;
      }
      if (!this.#isOpen) return;
      this.about = answer.about;
      // Within minutes there are hardly any epochs of natural frequencies.
      if (!this.about.is_filtered) Object.assign(this.span, { usual_s: DAY_S, length_s: DAY_S });
      this.span.newest_s = answer.overview.time_s;
      this.#build(answer.standing);
      this.#attend(answer.overview);
      this.#goto(this.tab, parameters);
      this.#show(answer.standing);
      this.connection.listen(this.name);
    } catch (error) {
      if (this.about) throw error; // a mistake in the page, not in the connection
      this.body.replaceChildren(h("p", { class: "empty" }, t("cannot-reach-spandrel-retrying")));
      setTimeout(() => this.#isOpen && this.#load(parameters), 2000);
    }
  }

  #build(standing) {
    this.#standing = standing;
    const page = {
      name: this.name,
      about: this.about,
      points: this.points,
      span: this.span,
      scale: this.scale,
      standing: () => this.#standing,
      told: () => this.parts?.sentence.textContent ?? "",
      choose: (parameter) => (location.hash = place(this.name, parameter)),
      changed: () => this.#remember(),
    };
    const { is_filtered: isFiltered } = this.about;
    // A station publishes neither residuals nor noise levels, nor a verdict on the fit.
    this.tabs = [new NowTab(page), ...(this.about.has_model ? [new ParametersTab(page)] : []), ...(this.about.parameters.length + this.about.modes.length > 0 ? [new CompareTab(page)] : []), ...(this.about.judged.length > 0 ? [new LastingTab(page)] : []), ...(isFiltered && !this.about.distributed ? [new ModelTab(page)] : []), new SensorsTab(page), new EventsTab(page), new SettingsTab(page)];
    if (!this.#current) this.tab = "now"; // the address names a tab that this structure lacks
    this.bar = new Tabs(this.tabs.map(({ key, element }) => ({ key, element, title: TABS[key] })), t("views-of", this.name), (key) => this.#open(key));
    this.ranges = new RangeBar(this.span, () => this.points.csv(this.#current.names ?? [...new Set(this.#current.plots.flatMap(({ plot }) => plot.names))]), {
      report: () => reportOf([this.name], this.span.isLive ? { length_s: this.span.length_s } : this.span),
      samples: this.about.distributed ? null : samplesExport(this.name, () => [this.span.shown.min, this.span.shown.max], t("chosen-range")),
    });
    this.body.replaceChildren(h("div", { class: "sticky" }, this.bar.list, this.ranges.element), ...this.bar.panels, this.dialog.element);
  }

  /** Opens a tab as a new entry of the browser's history. */
  #open(key) {
    if (key === this.tab) return;
    this.#showTab(key);
    history.pushState(null, "", this.#address());
    this.#shown = location.hash;
  }

  /** Shows a tab. The points of the former tab are dropped, so that hidden plots take no work. */
  #showTab(key) {
    this.#current.plots.forEach((plot) => plot.hide());
    this.points.clear();
    this.tab = key;
    // Before the plots fetch the past, so that nothing is missing between both.
    this.connection.want(Boolean(this.#current.hasWaveforms));
    this.bar.show(key);
    this.#foldHead();
    setText(this.printed, ` – ${TABS[key]}`);
    this.ranges.element.hidden = !this.#current.hasSpan;
    this.#current.plots.forEach((plot) => plot.show());
    this.#current.restart?.();
    if (this.#standing) this.#current.update(this.#standing);
  }

  /** Shows what only a print needs: the contact, the age of the data, the span, and the time of the print. */
  #unfold() {
    if (!this.parts || !this.#current) return;
    this.#current.draw?.({ isPrint: true });
    this.#wasOpen ??= this.parts.more.open;
    this.parts.more.open = true;
    const span = this.#current.hasSpan ? this.span : this.#current.span;
    const at = this.#current.key === "lasting" ? dateOf : time;
    const { min, max } = span?.shown ?? {};
    // The newest events have no span.
    const isKnown = Number.isFinite(min) && Number.isFinite(max) && !(this.#current.key === "events" && span.isLive);
    const shown = isKnown ? [t("report-period", at(min), at(max), duration(max - min))] : [];
    const texts = [this.about.description, ...shown, t("printed-at", time(Date.now() / 1000))];
    setText(this.paper, texts.filter(Boolean).join(" · "));
  }

  /** Restores the details as they were before a print. */
  #restoreFold() {
    if (this.#wasOpen !== null) this.parts.more.open = this.#wasOpen;
    this.#wasOpen = null;
  }

  /** Folds the details of the state away, except beside the parts. The plots of the other tabs need the room. */
  #foldHead() {
    const isNow = this.tab === "now";
    this.head.dataset.tab = this.tab;
    this.parts.more.open = isNow;
    this.parts.more.firstChild.hidden = isNow;
  }

  #address() {
    return addressOf({ structure: this.name, tab: this.tab, parameter: this.#current?.chosen, span: this.#current?.span ?? this.span, isOwnScale: !this.scale.isCommon, more: this.#current?.query });
  }

  /**
   * Keeps the address in step with what is shown, so that a reload shows the same. If a link has just
   * changed the address, its event is yet to come, and the address stays.
   */
  #remember() {
    if (!this.about || !this.#isOpen || location.hash !== this.#shown) return;
    history.replaceState(null, "", this.#address());
    this.#shown = location.hash;
  }

  #attend(overview) {
    const level = attentionWords(overview);
    this.head.dataset.level = overview.level;
    const { sensors } = overview;
    const severity = ({ credibility: probability = 1, loss }) => ({ probability, loss: loss ?? 0 });
    const alerts = this.#standing ? alertsOf(this.#standing) : [];
    // The judgement states no probability of a lasting loss, which is as good as certain.
    const raised = alerts.filter(canBeSeen).sort((a, b) => isLasting(b) - isLasting(a) || (a.state === "cleared") - (b.state === "cleared") || bySeverity(severity(a), severity(b)));
    const badge = (name) => h("span", { class: "badge", "data-level": name });
    this.parts ??= { badge: h("span", { class: "badge" }), seen: badge("notice"), stale: badge("stale"), sentence: h("p", { class: "sentence", lang: SERVICES }), figures: h("p", { class: "seen dated" }), now: h("p", { class: "now", lang: SERVICES, hidden: true }), also: h("p", { class: "also", lang: SERVICES }), quakes: h("ol", { class: "reported" }), facts: h("p", { class: "facts-line" }), actions: h("div", { class: "actions" }), others: h("div", { class: "actions" }), othersTitle: h("summary"), help: makeHelp() };
    const { parts } = this;
    parts.folded ??= h("details", { class: "routine" }, parts.othersTitle, parts.others);
    parts.more ??= h("details", { class: "more", open: true }, h("summary", {}, t("more")), parts.help.element, parts.now, parts.also, parts.quakes, parts.facts);
    if (this.head.childElementCount === 0) this.head.append(h("div", { class: "badges" }, parts.badge, parts.seen, parts.stale), parts.sentence, parts.figures, parts.actions, parts.folded, parts.more);
    setText(parts.badge, `${level.sign} ${level.word}`);
    setSentence(parts.sentence, overview.sentence);
    this.#showDate(overview);
    showNow(parts.now, overview);
    showAlso(parts.also, overview);
    keyed(parts.quakes, overview.earthquake ? [overview] : [], ({ name }) => name, makeReported, (part, one) => updateReported(part, one, t("earthquake-report")));
    showAcknowledged(parts.seen, overview);
    showStale(parts.stale, overview);
    const alive = overview.ended ? t("record-has-ended") : t("sensors-alive-of", sensors.alive, sensors.total) + troubledWords(sensors);
    const followed = overview.has_model ? t("updated-from-natural-frequencies") : t("no-model-natural-frequencies-only");
    const facts = [...(overview.place ? [overview.place] : []), t("data-age", age(overview), overview.time_s ? t("and-measured", time(overview.time_s)) : ""), ...(overview.replayed ? [lag(null, true)] : overview.lag_s === null ? [] : [t("lag-is", lag(overview.lag_s))]), alive, ...(overview.is_filtered ? [t("facts-monitoring", wordOf(overview.monitoring ?? "unknown")), t("facts-fit", overview.fit ? fitWord(overview) : t("not-judged-by-the-filter"))] : [followed])];
    keyed(parts.facts, facts, (text) => `${facts.indexOf(text)} ${text === alive}`, (text) => ({ element: text === alive ? h("a", { href: sensorsOf(this.name) }) : h("span") }), ({ element }, text) => {
      setSentence(element, text);
      // The sentence names only some of many.
      if (text === alive) element.title = sensors.troubled.join(", ");
    });
    const make = () => {
      const part = { element: h("button", { type: "button", class: "acknowledge", onclick: () => this.dialog.open(part.alert) }) };
      return part;
    };
    const update = (part, alert) => {
      part.alert = alert;
      const label = isLasting(alert) ? t("acknowledge-lasting-loss", alert.parameter) : t("acknowledge-part", alert.parameter);
      labelButton(part.element, alert, label, t("mark-part-as-seen", alert.parameter));
    };
    keyed(parts.actions, raised.slice(0, MOST_BUTTONS), keyOfAlert, make, update);
    keyed(parts.others, raised.slice(MOST_BUTTONS), keyOfAlert, make, update);
    parts.folded.hidden = raised.length <= MOST_BUTTONS;
    setText(parts.othersTitle, t("further-alerts", raised.length - MOST_BUTTONS));
    updateHelp(parts.help, alerts);
    this.tabs?.[0].attend(overview);
  }

  /**
   * Shows the time of the figures in the sentence. It is revised only if the loss has changed clearly, so
   * that its figures can differ from the newest ones beside it.
   */
  #showDate({ part }) {
    const isDated = ({ parameter, state }) => parameter === part && DATED.includes(state);
    const alert = this.#standing?.alerts.find(isDated);
    this.parts.figures.hidden = !alert;
    if (alert) setSentence(this.parts.figures, t("figures-of-the-alert", time(alert.time_ns / 1e9)));
  }

  #show(standing) {
    this.#standing = standing;
    if (!this.about) return;
    this.tabs.forEach((tab) => tab.discover?.(standing));
    this.#current.update(standing);
    this.dialog.update(alertsOf(standing));
    this.#current.plots.forEach((plot) => plot.plot.marks && plot.dirty());
  }

  #take(series) {
    if (!this.about) return;
    const changed = new Set(this.points.take(series));
    this.#current.take?.(series);
    if (!this.span.isLive) return;
    for (const plot of this.#current.plots) {
      if (plot.plot.names.some((name) => changed.has(name))) plot.dirty();
    }
  }

  #draw() {
    if (document.hidden || !this.ranges) return;
    this.ranges.update();
    const { plots } = this.#current;
    if (this.scale.hasChanged) {
      this.scale.hasChanged = false;
      plots.forEach((plot) => plot.dirty());
    }
    plots.forEach((plot) => plot.draw());
    this.#current.draw?.();
    // Also fetches the plots outside the window, one at a time, because a print shows them.
    plots.find((plot) => plot.isUnfetched)?.fetch();
  }

  #respan() {
    this.span.keptFrom_s = null;
    this.span.late.clear();
    this.ranges?.update();
    this.#remember();
    this.#current?.plots.forEach((plot) => plot.restart());
    this.#current?.restart?.();
  }

  /** Shows the tab, the parameter and the moment in the address. */
  #goto(tab, parameters) {
    this.#shown = location.hash;
    const parameter = parameters.get("parameter");
    this.scale.isCommon = parameters.get("scale") !== "own";
    const isThere = this.tabs.some(({ key }) => key === tab);
    this.#showTab(isThere ? tab : parameter ? "parameters" : "now");
    const span = spanOf(parameters, AROUND_S);
    const shown = this.#current.span ?? this.span;
    if (span?.length_s) shown.live(span.length_s);
    else if (span) shown.fix(span.from_s, span.to_s);
    else if (!shown.isLive || shown.length_s !== shown.usual_s) shown.live(shown.usual_s);
    this.#current.goto?.(parameters.get("quantity") ?? parameter, parameters);
    this.#remember();
  }
}
