// The tab of the present state: the drawing, the parts, and the part that needs attention most.

import { h, keyed, setAttribute, setText } from "./dom.js";
import { Drawing } from "./drawing.js";
import { PlotGroup } from "./groups.js";
import { language, t } from "./language.js";
import { modePlot, parameterPlot } from "./plots.js";
import { searchField } from "./search.js";
import { COLUMNS, HINTS, NOT_STIFFNESS, NO_RULE, SERVICES, bySeverity, isBlind, isOpen, judged, judgedEstimate, judgementWords, modeWords, notJudged, openWords, percent, place, probability, ratio, setSentence, stateOf, step } from "./words.js";

/** Probability of loss from which the plot of a part is shown at the top. */
const WORTH_SHOWING = 0.05;
/** Levels of the parts that are first in the table. */
const TROUBLE = ["alarm", "warning", "notice"];

export class NowTab {
  key = "now";
  hasSpan = true;
  #worst = null;

  constructor(page) {
    this.page = page;
    const { about } = page;
    this.drawing = new Drawing(about, page.choose);
    this.rows = h("tbody");
    this.ruled = new Set(about.rules.flatMap(({ parameters }) => parameters));
    const losses = new Set(about.rules.map(({ loss }) => loss));
    const [part, state, , interval, chance] = COLUMNS.parts;
    const titles = [part, state, t("value-with-std"), interval, losses.size === 1 ? t("loss-probability-of-rule", percent([...losses][0], 0)) : chance];
    const heads = h("tr", {}, titles.map((text) => h("th", { scope: "col" }, text)));
    const scroll = { class: "scroll", tabindex: "0", role: "region", "aria-label": t("parts") };
    const table = h("div", scroll, h("table", { class: "parameters" }, h("thead", {}, heads), this.rows));
    this.search = searchField(about.parameters.length, t("find-a-part"), () => this.#found());
    this.worst = h("section", { class: "card worst", hidden: true });
    const parts = h("section", { class: "card parts", hidden: about.parameters.length === 0 }, h("div", { class: "card-head" }, h("h2", {}, t("parts")), this.search.element), table);
    this.judgements = h("ul", { class: "sensor-list", id: "judgements" });
    this.noJudgement = h("p", { class: "group-text" }, t("the-service-judge-has-not-reported-yet"));
    const lasting = h("section", { class: "card", id: "lasting", hidden: about.judged.length === 0 }, h("h2", {}, t("lasting-change")), this.noJudgement, this.judgements);
    this.modes = h("tbody");
    const modeHeads = h("tr", {}, COLUMNS.modes.map((text) => h("th", { scope: "col", title: HINTS[text] }, text)));
    const modeScroll = { class: "scroll", id: "modes", tabindex: "0", role: "region", "aria-label": t("natural-frequencies") };
    this.modeTable = h("div", modeScroll, h("table", { class: "sensors" }, h("thead", {}, modeHeads), this.modes));
    this.noMode = h("p", { class: "group-text" }, t("the-service-modes-has-not-completed-an"));
    const natural = h("section", { class: "card", id: "natural-frequencies", hidden: about.modes.length === 0 }, h("h2", {}, t("natural-frequencies")), h("p", { class: "group-text" }, t("frequency-with-its-95-per-cent-interval")), this.noMode, this.modeTable);
    this.frequencies = new PlotGroup("modes", t("natural-frequencies-over-time"), t("each-epoch-is-a-point-bands-50"));
    const isWide = this.drawing.isWide;
    // Without parts, the natural frequencies are beside the drawing.
    const beside = about.parameters.length > 0 ? [parts, isWide ? null : this.worst] : [natural, lasting];
    const below = about.parameters.length > 0 ? [isWide ? this.worst : null, lasting, natural] : [];
    this.element = h("div", {}, h("div", { class: isWide ? "top is-wide" : "top" }, h("section", { class: "card drawn" }, this.drawing.element), h("div", {}, beside)), below, this.frequencies.element);
  }

  /** What only this tab states in the address. */
  get query() {
    return { find: this.search.text() };
  }

  /** Searches for the text in the address. */
  goto(_, parameters) {
    this.search.enter(parameters.get("find") ?? "");
    if (this.page.standing()) this.update(this.page.standing());
  }

  #found() {
    this.update(this.page.standing());
    this.page.changed();
  }

  get plots() {
    return [...(this.#worst ? [this.#worst.plot] : []), ...this.frequencies.plots];
  }

  /**
   * Shows the plot of the part in the sentence, or else of the one with the highest probability of loss, or
   * without a filter of the softest one.
   */
  attend({ part, worst }) {
    const { about, standing, points, span } = this.page;
    const mean = ({ name }) => standing()?.parameters[name]?.mean ?? Infinity;
    const softest = about.is_filtered ? null : about.parameters.filter(({ stiffness }) => stiffness).sort((a, b) => mean(a) - mean(b))[0];
    // Among sound parts the order changes constantly and means nothing.
    const name = part ?? (worst && worst.probability_of_loss >= WORTH_SHOWING ? worst.parameter : (softest?.name ?? this.#worst?.name ?? about.parameters[0]?.name));
    const parameter = about.parameters.find((parameter) => parameter.name === name);
    if (!parameter || this.#worst?.name === name) return;
    this.#worst?.plot.close();
    const plot = parameterPlot(parameter, standing, points, span, null, "worst");
    this.#worst = { name, plot };
    this.worst.replaceChildren(plot.element);
    this.worst.hidden = false;
  }

  update(standing) {
    this.drawing.update(standing);
    const update = (part, parameter) => {
      const shown = standing.parameters[parameter.name];
      const alert = standing.alerts.find((alert) => alert.parameter === parameter.name);
      const state = alert ? stateOf(alert) : null;
      part.element.dataset.level = state?.level ?? "learning";
      setAttribute(part.cell, "title", alert?.unwatched?.why || null);
      setAttribute(part.cell, "lang", alert?.unwatched?.why ? SERVICES : null);
      setText(part.state, state ? `${state.sign} ${state.word}${alert.stale ? t("stale") : ""}` : !this.page.about.is_filtered ? notJudged(this.page.about) : this.ruled.has(parameter.name) ? t("no-decision-yet") : NO_RULE);
      const loss = standing.losses[parameter.name];
      // Without a finding, the interval of the filter would contradict the probability beside it.
      const own = isOpen(alert) && parameter.stiffness && loss ? judgedEstimate({ loss: loss.loss, ...loss.interval }, loss.reference) : null;
      const { low, high } = own ?? shown?.interval ?? {};
      setText(part.mean, own ? ratio(own.mean) : shown ? `${ratio(shown.mean)} ± ${ratio(shown.std)}` : "–");
      setText(part.interval, own ?? shown ? t("range", ratio(low), ratio(high)) : "–");
      const p = parameter.stiffness ? loss?.probability_of_loss : null;
      const told = p === null ? NOT_STIFFNESS : probability(p, loss?.rule_credibility);
      // The number of a part without a decision is no finding, so it has no bar. Nor has one of the past.
      const isFound = p != null && !isOpen(alert) && !isBlind(alert);
      setText(part.text, p == null ? told : isBlind(alert) ? t("last-known", told) : openWords(alert, told));
      part.bar.hidden = !isFound;
      part.bar.dataset.step = step(p) ?? "";
      part.bar.style.setProperty("--share", p ?? 0);
    };
    const make = (parameter) => {
      const [state, mean, interval, text, bar] = [h("span", { lang: language }), h("td", { class: "number" }), h("td", { class: "number" }), h("span", { class: "number" }), h("span", { class: "meter", "aria-hidden": "true" })];
      const cell = h("td", {}, state);
      const element = h("tr", {}, h("th", { scope: "row" }, h("a", { href: place(this.page.name, parameter.name) }, parameter.name)), cell, mean, interval, h("td", {}, bar, text));
      return { element, cell, state, mean, interval, text, bar };
    };
    // Trouble first, the most severe before the others. Otherwise the order of the structure file, because
    // the order of sound parts changes constantly and means nothing.
    const rank = ({ name }) => {
      const alert = standing.alerts.find(({ parameter }) => parameter === name);
      return TROUBLE.indexOf(alert ? stateOf(alert).level : "") + 1 || TROUBLE.length + 1;
    };
    const severity = ({ name }) => ({ probability: standing.losses[name]?.probability_of_loss ?? 0, loss: standing.losses[name]?.loss ?? 0 });
    const compare = (a, b) => rank(a) - rank(b) || (rank(a) > TROUBLE.length ? 0 : bySeverity(severity(a), severity(b)));
    const found = this.page.about.parameters.filter(({ name }) => this.search.finds(name)).sort(compare);
    keyed(this.rows, found, (parameter) => parameter.name, make, update);
    this.#showJudgements(standing);
    this.#showModes(standing);
  }

  /** Creates the plots of modes that were found. */
  discover({ modes }) {
    const { points, span } = this.page;
    for (const { mode, estimate } of modes) if (estimate) this.frequencies.add(mode, () => modePlot(mode, points, span));
  }

  #showModes({ modes }) {
    this.noMode.hidden = modes.length > 0;
    this.modeTable.hidden = modes.length === 0;
    const make = () => {
      const cells = COLUMNS.modes.map((head, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": head })));
      return { element: h("tr", {}, cells), cells };
    };
    keyed(this.modes, modes, ({ mode }) => mode, make, ({ element, cells }, mode) => {
      const { level, cells: texts } = modeWords(mode);
      element.dataset.level = level;
      texts.forEach((text, column) => setText(cells[column], text));
    });
  }

  #showJudgements({ judgements }) {
    this.noJudgement.hidden = judgements.length > 0;
    keyed(this.judgements, judgements, (judgement) => judgement.quantity, (judgement) => {
      const text = h("span", { lang: SERVICES });
      return { element: h("li", {}, text, " ", h("a", { href: judged(this.page.name, judgement.quantity), "aria-label": t("show-the-year-of", judgement.quantity) }, t("show-the-year"))), text };
    }, (part, judgement) => {
      const { level, text } = judgementWords(judgement);
      part.element.dataset.level = level;
      setSentence(part.text, text);
    });
  }
}
