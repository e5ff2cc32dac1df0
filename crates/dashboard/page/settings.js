// The tab of the settings in force: the rates and rules of the structure file, and the services.

import { grouped, h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { COLUMNS, count, lag, natural, number, unit, wordOf } from "./words.js";

/** Maximum number of parameters with one prior, or of noise levels with one value, that are named. */
const MOST_NAMED = 8;
/** Length of a text above which it has a row of its own. */
const LONG = 60;

/** Returns what identifies the structure. */
function identification({ is_filtered: isFiltered, has_model: hasModel, distributed }) {
  if (!isFiltered) return hasModel ? t("updated-from-natural-frequencies") : t("no-model-natural-frequencies-only");
  return distributed ? t("by-each-node-combined-by-a-station") : t("in-one-place");
}

/** Returns the names of few parameters or noise levels or the number of many. */
function listed(all, many) {
  return all.length > MOST_NAMED ? many(all.length) : all.map(({ name }) => name).join(", ");
}

/** Returns the facts of the judgement of lasting change: titles and texts. */
function judged({ judged: quantities, judge: { false_alarms_per_year: budget, loss, commissioning_days: days, conditions } }) {
  return [
    [t("budget-of-the-structure"), t("false-alarms-a-year", number(budget))],
    [t("loss-that-matters"), t("of-stiffness", `${number(100 * loss)} %`)],
    [t("commissioning"), t("days", days)],
    [t("judged-quantities"), quantities.join(", ")],
    [t("conditions"), conditions.join(", ") || t("none")],
  ];
}

export class SettingsTab {
  key = "settings";
  hasSpan = false;
  plots = [];

  constructor({ about }) {
    this.services = h("tbody");
    const heads = (columns) => h("thead", {}, h("tr", {}, columns.map((text) => h("th", { scope: "col" }, text))));
    const scroll = (label) => ({ class: "scroll", tabindex: "0", role: "region", "aria-label": label });
    const row = (cells) => h("tr", {}, cells.map((text, column) => (column === 0 ? h("th", { scope: "row" }, text) : h("td", { "data-head": COLUMNS.rules[column] }, text))));
    const rules = about.rules.map(({ parameters, loss, credibility, sustain_s, learn_s: learn }) => row([parameters.join(", "), t("more-than", `${number(100 * loss)} %`), `${number(100 * credibility)} %`, `${number(sustain_s)} s`, learn === null ? t("stated-reference") : t("learnt-in", number(learn))]));
    const fact = (title, text, link) => h("div", { class: text.length > LONG ? "fact fact-long" : "fact" }, h("dt", {}, title), h("dd", {}, link ? h("a", { href: link, rel: "noreferrer" }, text) : text));
    // Many parameters have few different priors.
    const priors = grouped(about.parameters, ({ prior }) => prior.join()).map((equal) => `${equal[0].prior.map(number).join(" ± ")}: ${listed(equal, (size) => t("many-parameters", size))}`);
    const levels = grouped(about.noise.toSorted((a, b) => natural(a.name, b.name)), ({ std, unit: of }) => `${std} ${of}`);
    const noise = levels.map((equal) => `${listed(equal, (size) => t("many-channels", size))} ${number(equal[0].std)} ${unit(equal[0].unit)}`.trim());
    const range = ({ name, unit: of, range }) => (range ? t("settings-range", name, number(range[0]), number(range[1]), unit(of)) : `${name} (${unit(of)})`);
    this.element = h(
      "div",
      {},
      h(
        "section",
        { class: "card" },
        h("h2", {}, t("structure-file")),
        h("p", { class: "description" }, about.description),
        h(
          "dl",
          { class: "facts" },
          fact(t("sampling-rate"), `${number(about.sampling_rate_hz)} Hz`),
          fact(t("display-rate"), `${number(about.display_rate_hz)} Hz`),
          fact(t("identification"), identification(about)),
          fact(t("parameters"), String(about.parameters.length)),
          fact(t("channels"), String(about.drawing.sensors.length)),
          about.is_filtered && fact(t("half-life"), `${number(about.half_life_s)} s`),
          about.is_filtered && fact(t("priors"), priors.join("; ") || t("none")),
          about.is_filtered && fact(t("noise-levels"), noise.join("; ") || t("none")),
          fact(t("whom-to-call"), about.contact || t("none")),
          fact(t("runbook"), about.runbook || t("none"), about.runbook),
          fact(t("conditions"), about.conditions.map(range).join(", ") || t("none")),
        ),
      ),
      h("section", { class: "card" }, h("h2", {}, t("alert-rules")), rules.length > 0 && !about.is_filtered ? h("p", { class: "group-text" }, t("without-a-filter-these-rules-raise-no")) : null, rules.length > 0 ? h("div", scroll(t("alert-rules")), h("table", { class: "rules" }, heads(COLUMNS.rules), h("tbody", {}, rules))) : h("p", { class: "group-text" }, about.judge ? t("no-rule-but-judged") : t("the-structure-file-contains-no-rule"))),
      about.judge && h("section", { class: "card", id: "settings-judge" }, h("h2", {}, t("lasting-change")), h("p", { class: "group-text" }, t("hint-settings-judge")), h("dl", { class: "facts" }, judged(about).map((of) => fact(...of)))),
      h("section", { class: "card" }, h("h2", {}, t("services")), h("div", scroll(t("services")), h("table", { class: "services" }, heads(COLUMNS.services), this.services))),
    );
  }

  update({ services }) {
    const make = () => {
      const cells = COLUMNS.services.map((_, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { "data-head": COLUMNS.services[column] })));
      return { element: h("tr", {}, cells), cells };
    };
    // The services keep their order, and the instances of each have their natural one.
    const sorted = grouped(services, ({ service }) => service).flatMap((of) => of.toSorted((a, b) => natural(a.id, b.id)));
    keyed(this.services, sorted, (service) => `${service.service}/${service.id}`, make, ({ cells }, { service, id, present, lag_s, status }) => {
      const drops = Object.entries(status?.drops ?? {}).map(([reason, dropped]) => `${wordOf(reason)}: ${count(dropped)}`);
      const texts = [service === id ? service : `${service} ${id}`, present ? t("service-alive") : t("service-gone"), lag(lag_s), status ? count(status.done) : "–", drops.join(", ") || t("nothing")];
      texts.forEach((text, column) => setText(cells[column], text));
    });
  }
}
