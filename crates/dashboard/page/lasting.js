// The tab of lasting change: the judged quantities, and the year of one of them.

import { CoursePoints, dateOf, noon } from "./course.js";
import { h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { NoteDialog } from "./note.js";
import { RangeBar } from "./ranges.js";
import { DAY_S, Span } from "./span.js";
import { COLUMNS, LEVELS, judged, judgementWords, number, percent, setSentence, wordOf, SERVICES } from "./words.js";
import { Extent, conditionScatter, conditionTitle, evidencePlot, residualPlot, valuePlot } from "./year.js";

/** Selectable lengths (s). */
const LENGTHS = [
  [30 * DAY_S, t("1-month")],
  [92 * DAY_S, t("3-months")],
  [366 * DAY_S, t("1-year")],
  [2 * 366 * DAY_S, t("2-years")],
  [10 * 366 * DAY_S, t("10-years")],
];
/** Length that is shown first: a year. */
const YEAR_S = 366 * DAY_S;

export class LastingTab {
  key = "lasting";
  /** The tab has a span of its own, because a judgement needs days and not seconds. */
  hasSpan = false;
  #known = null;

  constructor(page) {
    this.page = page;
    this.span = Object.assign(new Span(), { usual_s: YEAR_S, length_s: YEAR_S });
    this.extent = new Extent();
    this.points = new CoursePoints(page.name, this.span);
    this.points.quantity = page.about.judged[0] ?? null;
    this.list = h("ul", { class: "quantities", "aria-label": t("judged-quantities") });
    this.title = h("h2");
    this.sentence = h("p", { class: "sentence", lang: SERVICES });
    this.facts = h("dl", { class: "facts" });
    this.delays = h("tbody");
    const heads = COLUMNS.delays.map((text) => h("th", { scope: "col" }, text));
    this.finds = h("table", { class: "delays" }, h("caption", {}, t("what-the-reference-finds-in-simulated-years")), h("thead", {}, h("tr", {}, heads)), this.delays);
    this.ranges = new RangeBar(this.span, () => this.points.csv(), { lengths: LENGTHS, key: "year", isOfDays: true });
    this.scatter = conditionScatter(this.points, this.span, this.extent);
    const values = valuePlot(this.points, this.span);
    this.plots = [values, residualPlot(this.points, this.span), evidencePlot(this.points, this.span), this.scatter];
    values.element.classList.add("is-wide");
    this.trouble = h("p", { class: "empty", role: "status", hidden: true });
    this.notes = h("ul", { class: "notes" });
    this.saved = h("p", { class: "group-text", role: "status" });
    this.dialog = new NoteDialog(page.name, page.about.judged, (text) => {
      setText(this.saved, text);
      this.#reload();
    });
    const open = () => {
      setText(this.saved, "");
      this.dialog.open(this.chosen);
    };
    const add = h("button", { type: "button", id: "add-note", onclick: open }, t("add-a-note"));
    const noted = h("section", { class: "card noted" }, h("div", { class: "card-head" }, h("h3", {}, t("notes-of-people")), add), this.saved, this.notes, this.dialog.element);
    const reference = h("section", { class: "card reference" }, h("h3", {}, t("reference-and-budget")), this.facts, this.finds);
    const plots = h("div", { class: "plots", id: "year" }, this.plots.map(({ element }) => element), reference, noted);
    this.seen = h("p", { class: "seen" });
    this.card = h("section", { class: "card judged" }, this.title, this.sentence, this.seen);
    this.element = h("section", { class: "group", id: "group-lasting" }, this.list, this.card, this.ranges.element, this.trouble, plots);
    this.span.onchange(() => this.#respan());
    this.extent.onchange(() => this.scatter.dirty());
  }

  get chosen() {
    return this.points.quantity;
  }

  update({ judgements }) {
    const make = (quantity) => {
      const [sign, name, state] = [h("span", { class: "sign", "aria-hidden": "true" }), h("span", { class: "name" }, quantity), h("span", { class: "word" })];
      const link = h("a", { href: judged(this.page.name, quantity) }, sign, name, state);
      return { element: h("li", {}, link), link, sign, state };
    };
    keyed(this.list, this.page.about.judged, (quantity) => quantity, make, ({ link, sign, state }, quantity) => {
      const judgement = judgements.find((judgement) => judgement.quantity === quantity);
      const { level } = judgement ? judgementWords(judgement) : { level: "learning" };
      link.dataset.level = level;
      if (quantity === this.chosen) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
      setText(sign, LEVELS[level].sign);
      setText(state, judgement ? wordOf(judgement.word) : t("not-reported-yet"));
      link.title = judgement?.word === "outside-experience" ? t("hint-outside-experience") : "";
    });
    const judgement = judgements.find(({ quantity }) => quantity === this.chosen);
    this.#show(judgement);
    // A new day, or another service that judges, changes the course.
    const stamp = judgement ? JSON.stringify([this.chosen, judgement.day_ns, judgement.change, judgement.seen, judgement.state, judgement.spent]) : null;
    if (stamp === this.#known) return;
    this.#known = stamp;
    if (judgement?.day_ns != null) this.span.newest_s = noon(judgement.day_ns);
    this.#reload();
  }

  /** Draws what has arrived since the last call. */
  draw() {
    this.ranges.update();
    const { course, trouble } = this.points;
    this.scatter.element.hidden = course !== null && course.conditions.length === 0;
    this.trouble.hidden = trouble === null;
    if (trouble !== null) setText(this.trouble, t("no-days", trouble));
    if (course !== this.shown) {
      this.shown = course;
      this.#tell(course);
    }
  }

  /** Fetches the days again, as after a lost connection. */
  restart() {
    this.#reload();
  }

  /** Shows the quantity in the address. */
  goto(quantity) {
    const { judged } = this.page.about;
    const found = judged.includes(quantity) ? quantity : (judged[0] ?? null);
    if (found !== this.chosen) {
      this.points.quantity = found;
      this.extent.live();
      this.#reload();
    }
    this.update(this.page.standing());
  }

  #show(judgement) {
    const level = judgement ? judgementWords(judgement).level : "learning";
    this.card.dataset.level = level;
    setText(this.title, `${LEVELS[level].sign} ${this.chosen ?? t("no-quantity")}`);
    setSentence(this.sentence, judgement?.sentence ?? t("the-service-judge-has-not-reported-yet"));
    const seen = judgement?.seen;
    // The plots need the room, if the sentence is at the top of the page, maybe between others.
    const own = this.sentence.textContent.replace(/\.$/, "");
    this.sentence.hidden = `; ${this.page.told()}; `.includes(`; ${own}; `);
    this.card.hidden = this.sentence.hidden && !seen;
    this.spent = judgement?.spent ?? null;
    this.seen.hidden = !seen;
    if (seen) setText(this.seen, t("seen-by-on", seen.who, dateOf(seen.time_ns / 1e9), seen.text));
  }

  /** Shows what the reference promises, or what is missing. */
  #tell(course) {
    const fact = ([title, text]) => h("div", { class: "fact" }, h("dt", {}, title), h("dd", {}, text));
    this.facts.replaceChildren(...(course ? [...facts(course), ...spending(this.spent)].map(fact) : []));
    const delays = course?.reference?.delays ?? [];
    const row = ({ loss, median_days: days, found_in_a_month: share }) => h("tr", {}, h("th", { scope: "row" }, percent(loss, 0)), h("td", {}, days === null ? t("mostly-missed") : t("days", days)), h("td", {}, percent(share, 0)));
    const notes = (course?.annotations ?? []).toReversed();
    this.notes.replaceChildren(...notes.map(note));
    const [condition] = course?.conditions ?? [];
    if (condition) this.scatter.retitle(t("measured-over", conditionTitle(condition)));
    this.finds.hidden = delays.length === 0;
    this.delays.replaceChildren(...delays.map(row));
  }

  #respan() {
    this.plots.forEach((plot) => plot.restart());
    this.page.changed();
  }

  #reload() {
    this.points.forget();
    this.plots.forEach((plot) => plot.restart());
  }
}

/** Returns the line of an annotation. The subject of an acknowledgement alone is "other". */
function note({ from_ns: from, to_ns: to, kind, effect, who, text }) {
  const end = to === null ? "" : t("to-date", dateOf(to / 1e9));
  const isSeen = effect === "seen";
  const what = [isSeen && kind === "other" ? null : wordOf(kind), isSeen ? t("note-acknowledged-by", who) : effect === "new-reference" ? t("new-reference") : null];
  const told = isSeen ? `: ${text}` : ` ${text} (${who})`;
  return h("li", {}, h("span", { class: "number" }, dateOf(from / 1e9) + end), " ", h("strong", {}, what.filter(Boolean).join(", ")), told);
}

/** Returns the facts of what the structure has spent of its budget: titles and texts. */
function spending(spent) {
  if (!spent) return [];
  const { judged_days: days, promised, alarms, alarms_in_last_year: recent } = spent;
  return [
    [t("judged-so-far"), t("days", days)],
    [t("alarms-of-the-structure"), t("alarms-of-them-in-the-last-year", alarms, recent)],
    [t("false-alarms-promised-so-far"), number(Number(promised.toPrecision(2)))],
  ];
}

/** Returns the facts of a course: titles and texts. */
function facts({ reference, rows, kind, loss, commissioning_days: needed, false_alarms_per_year: budget }) {
  const last = rows.at(-1);
  const day = last ? [[t("last-day"), t("epochs", dateOf(last.time), last.epochs)]] : [];
  const shared = [[t("loss-that-matters"), t("of-stiffness", percent(loss, 0))]];
  if (!reference) return [[t("reference"), t("needs-days-of-commissioning", needed)], [t("budget-of-the-structure"), t("false-alarms-a-year", number(budget))], ...shared, ...day];
  const { from_ns: from, to_ns: to, coverage, scatter, knows_frost: frost, promised_per_year: promised, achieved_per_year: achieved } = reference;
  return [
    [t("reference"), `${t("range", dateOf(noon(from)), dateOf(noon(to)))}${frost === false ? t("without-frost") : ""}`],
    [t("scatter-of-a-day"), t("of-the", percent(scatter, 2), wordOf(kind))],
    [t("later-days-in-the-95-per-cent"), percent(coverage, 0)],
    [t("promised-false-alarms-a-year"), t("of-for-the-structure", number(promised), number(budget))],
    [t("in-simulated-years"), t("a-year", number(achieved))],
    ...shared,
    ...day,
  ];
}
