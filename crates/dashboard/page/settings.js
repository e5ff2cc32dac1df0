// The tab of the settings in force: the rates and rules of the structure file, and the services.

import { h, keyed, setText } from "./dom.js";
import { COLUMNS, lag, natural, number, percent, unit } from "./words.js";

export class SettingsTab {
  key = "settings";
  hasSpan = false;
  plots = [];

  constructor({ about }) {
    this.services = h("tbody");
    const heads = (columns) => h("thead", {}, h("tr", {}, columns.map((text) => h("th", { scope: "col" }, text))));
    const scroll = (label) => ({ class: "scroll", tabindex: "0", role: "region", "aria-label": label });
    const row = (cells) => h("tr", {}, cells.map((text, column) => (column === 0 ? h("th", { scope: "row" }, text) : h("td", {}, text))));
    const rules = about.rules.map(({ parameters, loss, credibility, sustain_s }) => row([parameters.join(", "), `more than ${percent(loss)}`, String(credibility), `${number(sustain_s)} s`]));
    const fact = (title, text) => h("div", { class: "fact" }, h("dt", {}, title), h("dd", {}, text));
    const range = ({ name, unit: of, range }) => (range ? `${name} (${range[0]} to ${range[1]} ${unit(of)})` : `${name} (${unit(of)})`);
    this.element = h(
      "div",
      {},
      h(
        "section",
        { class: "card" },
        h("h2", {}, "Structure file"),
        h("p", { class: "description" }, about.description),
        h(
          "dl",
          { class: "facts" },
          fact("Sampling rate", `${number(about.sampling_rate_hz)} Hz`),
          fact("Display rate", `${number(about.display_rate_hz)} Hz`),
          fact("Identification", about.distributed ? "by each node, combined by a station" : "in one place"),
          fact("Parameters", String(about.parameters.length)),
          fact("Channels", String(about.drawing.sensors.length)),
          fact("Noise levels", about.noise.map(({ name }) => name).sort(natural).join(", ") || "none"),
          fact("Conditions", about.conditions.map(range).join(", ") || "none"),
        ),
      ),
      h("section", { class: "card" }, h("h2", {}, "Alert rules"), rules.length > 0 ? h("div", scroll("Alert rules"), h("table", {}, heads(COLUMNS.rules), h("tbody", {}, rules))) : h("p", { class: "group-text" }, "The structure file contains no rule.")),
      h("section", { class: "card" }, h("h2", {}, "Services"), h("div", scroll("Services"), h("table", { class: "services" }, heads(COLUMNS.services), this.services))),
    );
  }

  update({ services }) {
    const make = () => {
      const cells = COLUMNS.services.map((_, column) => (column === 0 ? h("th", { scope: "row" }) : h("td")));
      return { element: h("tr", {}, cells), cells };
    };
    keyed(this.services, services, (service) => `${service.service}/${service.id}`, make, ({ cells }, { service, id, present, lag_s, status }) => {
      const drops = Object.entries(status?.drops ?? {}).map(([reason, count]) => `${reason} ${count}`);
      const texts = [service === id ? service : `${service} ${id}`, present ? "● alive" : "✕ gone", lag(lag_s), status ? String(status.done) : "–", drops.join(", ") || "nothing"];
      texts.forEach((text, column) => setText(cells[column], text));
    });
  }
}
