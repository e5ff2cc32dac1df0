// One structure: why it needs attention, its drawing, its parameters, and all series over time.

import { AcknowledgeDialog } from "./alerts.js";
import { h, keyed, setText } from "./dom.js";
import { Drawing } from "./drawing.js";
import { NodeTable } from "./nodes.js";
import { age, showNow, showStale } from "./overview.js";
import { classPlot, conditionPlot, consistencyPlot, innovationPlot, nodePlot, noisePlot, outlierPlot, parameterPlot } from "./plots.js";
import { LENGTHS, Points, Span } from "./span.js";
import { FITS, HEALTH, LEVELS, canBeSeen, compared, conditionWords, duration, fitWord, judgementWords, lag, number, offset, percent, place, probability, ratio, sensorName, stateOf, step, time } from "./words.js";

/** Interval at which the plots are drawn (ms), independent of the rate of the points. */
const DRAW_EVERY_MS = 250;
/** Probability of loss from which the plot of a part is shown at the top. */
const WORTH_SHOWING = 0.05;
/** Time shown on each side of a moment that a link leads to (s). */
const AROUND_S = 60;

export class StructurePage {
  #plots = [];
  #made = new Map();
  #standing = null;
  #isOpen = true;
  #leave = [];

  constructor(connection, name, parameters) {
    this.name = name;
    this.span = new Span();
    this.points = new Points(name, this.span);
    this.head = h("div", { class: "attention" });
    this.body = h("div", {}, h("p", { class: "empty" }, "Loading …"));
    this.element = h("div", { class: "structure" }, h("p", { class: "crumb" }, h("a", { href: "#/" }, "Structures"), " / ", name), h("h1", {}, name), this.head, this.body);
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
    this.recolour = () => this.#plots.forEach((plot) => plot.recolour());
    this.scheme.addEventListener("change", this.recolour);
    this.timer = setInterval(() => this.#draw(), DRAW_EVERY_MS);
    this.span.onchange(() => this.#respan());
    this.#load(parameters);
  }

  close() {
    this.#isOpen = false;
    this.#leave.forEach((leave) => leave());
    clearInterval(this.timer);
    this.scheme.removeEventListener("change", this.recolour);
    this.#plots.forEach((plot) => plot.close());
  }

  /** Shows another moment or parameter of the same structure. */
  takes([kind, name], parameters) {
    if (kind !== "structure" || name !== this.name || !this.about) return false;
    this.#goto(parameters);
    return true;
  }

  async #load(parameters) {
    try {
      const response = await fetch(`/api/structures/${encodeURIComponent(this.name)}`);
      const answer = await response.json();
      if (!response.ok) {
        this.connection.listen(null);
        this.body.replaceChildren(h("p", { class: "empty" }, `${answer.error}; ${answer.allowed}. `, h("a", { href: "#/" }, "All structures")));
        return;
      }
      if (!this.#isOpen) return;
      this.about = answer.about;
      this.#build();
      this.span.newest_s = answer.overview.time_s;
      this.#show(answer.standing);
      this.#attend(answer.overview);
      this.#goto(parameters);
      this.connection.listen(this.name);
    } catch {
      this.body.replaceChildren(h("p", { class: "empty" }, "Cannot reach Spandrel. Retrying …"));
      setTimeout(() => this.#isOpen && this.#load(parameters), 2000);
    }
  }

  #build() {
    const { about } = this;
    const standing = () => this.#standing;
    this.drawing = new Drawing(about, (parameter) => (location.hash = place(this.name, parameter)));
    this.table = h("tbody");
    const heads = ["Part", "State", "Estimate", "95 % interval", "Probability of loss"];
    const table = h("div", { class: "scroll" }, h("table", { class: "parameters" }, h("thead", {}, h("tr", {}, heads.map((text) => h("th", { scope: "col" }, text)))), this.table));
    this.worst = h("div", { class: "worst" });
    this.ranges = new RangeBar(this.span);
    this.events = h("ul", { class: "events" });
    this.noEvents = h("p", { class: "group-text" }, "None since the dashboard was started.");
    this.sensorList = h("ul", { class: "sensor-list" });
    this.sensorNames = new Map(about.drawing.sensors.map((sensor) => [sensor.channel, `${sensorName(sensor)} of node ${sensor.node}`]));
    this.services = h("tbody");
    this.fit = h("p", { class: "fit", hidden: true });
    this.judgements = h("ul", { class: "sensor-list", id: "judgements" });
    this.noJudgement = h("p", { class: "group-text" }, "The service judge has not reported yet.");
    this.groups = {};
    const group = (key, title, text) => {
      const holder = h("div", { class: "plots" });
      const section = h("section", { class: "group", id: `group-${key}`, hidden: key !== "parameters" }, h("h2", {}, title), text ? h("p", { class: "group-text" }, text) : null, holder);
      this.groups[key] = { section, holder };
      return section;
    };
    this.body.replaceChildren(
      h("div", { class: "top" }, h("section", { class: "card" }, this.drawing.element), h("section", { class: "card" }, h("h2", {}, "Parts"), table, this.worst)),
      this.ranges.element,
      group("parameters", "Parameters", "Ratio to the design: 1 is as designed, 0.9 has lost 10 %. Line: estimate; bands: 50, 95 and 99.7 % intervals. Drag across a plot to zoom all of them."),
      group("classes", "Model classes"),
      group("nodes", "Distributed nodes", "A node far beyond the red dashed limit disagrees with the others."),
      group("agreement", "Model and data"),
      group("outliers", "Outliers"),
      group("innovations", "Innovations", "Observed minus predicted value: minimum and maximum in each interval."),
      group("noise", "Noise levels"),
      group("conditions", "Conditions", "Slow quantities that instruments measure beside the motion. Each value is a point."),
      h("section", { class: "card", id: "lasting", hidden: about.judged.length === 0 }, h("h2", {}, "Lasting change"), this.noJudgement, this.judgements),
      h("section", { class: "card", id: "sensors" }, h("h2", {}, "Sensors"), this.sensorList, this.fit),
      h("section", { class: "card" }, h("h2", {}, "Events"), this.noEvents, this.events),
      h("section", { class: "card" }, h("h2", {}, "Services"), h("div", { class: "scroll" }, h("table", {}, h("thead", {}, h("tr", {}, ["Service", "State", "Lag", "Done", "Dropped or corrected"].map((text) => h("th", { scope: "col" }, text)))), this.services))),
      this.dialog.element,
    );
    this.nodes = new NodeTable();
    this.groups.nodes.holder.before(this.nodes.element);
    this.conditionList = h("ul", { class: "sensor-list", id: "conditions" });
    this.groups.conditions.holder.before(this.conditionList);
    for (const condition of about.conditions) this.#plot("conditions", condition.name, () => conditionPlot(condition, this.points, this.span));
    for (const parameter of about.parameters) this.#plot("parameters", parameter.name, () => parameterPlot(parameter, standing, this.points, this.span));
  }

  /** Creates a plot as soon as it has data. */
  #plot(group, key, make) {
    const id = `${group}/${key}`;
    if (this.#made.has(id)) return;
    const plot = make();
    this.#made.set(id, plot);
    this.#plots.push(plot);
    this.groups[group].section.hidden = false;
    this.groups[group].holder.append(plot.element);
  }

  /** Shows the plot of the part with the highest probability of loss at the top. */
  #showWorst({ worst }) {
    const { parameters } = this.about;
    // Among sound parts the order changes constantly and means nothing.
    const name = worst && worst.probability_of_loss >= WORTH_SHOWING ? worst.parameter : (this.worstPlot?.name ?? parameters[0]?.name);
    const parameter = parameters.find((parameter) => parameter.name === name);
    if (!parameter || this.worstPlot?.name === name) return;
    if (this.worstPlot) this.#drop(this.worstPlot.plot);
    const plot = parameterPlot(parameter, () => this.#standing, this.points, this.span, "worst");
    this.worstPlot = { name, plot };
    this.#plots.push(plot);
    this.worst.replaceChildren(plot.element);
  }

  #drop(plot) {
    plot.close();
    plot.element.remove();
    this.#plots = this.#plots.filter((other) => other !== plot);
  }

  #attend(overview) {
    if (this.about) this.#showWorst(overview);
    const level = LEVELS[overview.level];
    this.head.dataset.level = overview.level;
    const { sensors } = overview;
    const raised = (this.#standing?.alerts ?? []).filter(canBeSeen);
    this.parts ??= { badge: h("span", { class: "badge" }), stale: h("span", { class: "badge", "data-level": "stale" }), sentence: h("p", { class: "sentence" }), now: h("p", { class: "now" }), facts: h("p", { class: "facts-line" }), actions: h("div", { class: "actions" }) };
    if (this.head.childElementCount === 0) this.head.append(this.parts.badge, " ", this.parts.stale, this.parts.sentence, this.parts.now, this.parts.actions, this.parts.facts);
    setText(this.parts.badge, `${level.sign} ${level.word}`);
    setText(this.parts.sentence, overview.sentence);
    showNow(this.parts.now, overview.now, overview.age_s);
    showStale(this.parts.stale, overview);
    setText(this.parts.facts, `Data: ${age(overview)}${overview.time_s ? `, measured ${time(overview.time_s)}` : ""} · ${overview.replayed ? lag(null, true) : `lag ${lag(overview.lag_s)}`} · sensors alive ${sensors.alive} of ${sensors.total} · monitoring: ${overview.monitoring ?? "unknown"} · fit: ${fitWord(overview.fit)}`);
    keyed(
      this.parts.actions,
      raised,
      (alert) => alert.parameter,
      (alert) => ({ element: h("button", { type: "button", class: "acknowledge", onclick: () => this.dialog.open(alert) }, `Acknowledge ${alert.parameter}`) }),
      () => {},
    );
  }

  #show(standing) {
    this.#standing = standing;
    if (!this.about) return;
    this.drawing.update(standing);
    this.#showParameters(standing);
    this.#showLists(standing);
    for (const level of this.about.noise) {
      if (standing.noise[level.name]) this.#plot("noise", level.name, () => noisePlot(level, this.points, this.span));
    }
    for (const channel of Object.keys(standing.outliers)) this.#plot("outliers", channel, () => outlierPlot(channel, this.points, this.span));
    standing.series.forEach((name) => this.#discover(name));
    if (Object.keys(standing.nodes).length > 0) {
      const nodes = [...new Set(this.about.drawing.sensors.map((sensor) => sensor.node))];
      this.#plot("nodes", "all", () => nodePlot(nodes, this.points, this.span));
      this.nodes.update(nodes, standing.nodes);
    }
    this.dialog.update(standing.alerts);
    this.#plots.forEach((plot) => plot.plot.marks && plot.dirty());
  }

  #showParameters(standing) {
    const update = (part, parameter) => {
      const shown = standing.parameters[parameter.name];
      const alert = standing.alerts.find((alert) => alert.parameter === parameter.name);
      const state = alert ? stateOf(alert) : null;
      part.element.dataset.level = state?.level ?? "learning";
      part.state.title = alert?.unwatched?.why ?? "";
      setText(part.state, state ? `${state.sign} ${state.word}${alert.stale ? " (stale)" : ""}` : "– no decision");
      setText(part.mean, shown ? `${ratio(shown.mean)} ± ${ratio(shown.std)}` : "–");
      setText(part.interval, shown ? `${ratio(shown.interval.low)} to ${ratio(shown.interval.high)}` : "–");
      const loss = standing.losses[parameter.name];
      const p = parameter.stiffness ? loss?.probability_of_loss : null;
      setText(part.text, p === null ? "not a stiffness" : probability(p, loss?.rule_credibility));
      part.bar.hidden = p === null || p === undefined;
      part.bar.dataset.step = step(p) ?? "";
      part.bar.style.setProperty("--share", p ?? 0);
    };
    const make = (parameter) => {
      const [state, mean, interval, text, bar] = [h("td"), h("td", { class: "number" }), h("td", { class: "number" }), h("span", { class: "number" }), h("span", { class: "meter", "aria-hidden": "true" })];
      const element = h("tr", {}, h("th", { scope: "row" }, h("a", { href: place(this.name, parameter.name) }, parameter.name)), state, mean, interval, h("td", {}, bar, text));
      return { element, state, mean, interval, text, bar };
    };
    keyed(this.table, this.about.parameters, (parameter) => parameter.name, make, update);
  }

  #showLists({ events, services, sensors, outliers, nodes, fit, conditions, judgements }) {
    this.noJudgement.hidden = judgements.length > 0;
    keyed(this.judgements, judgements, (judgement) => judgement.quantity, () => ({ element: h("li") }), (part, judgement) => {
      const { level, text } = judgementWords(judgement);
      part.element.dataset.level = level;
      setText(part.element, text);
    });
    keyed(this.conditionList, conditions, (condition) => condition.name, () => ({ element: h("li") }), (part, condition) => {
      const { level, text } = conditionWords(condition);
      part.element.dataset.level = level;
      setText(part.element, text);
    });
    this.fit.hidden = !fit;
    if (fit) {
      this.fit.dataset.level = FITS[fit.verdict].level;
      setText(this.fit, `${FITS[fit.verdict].sign} Fit ${fit.verdict}: ${fit.words}.`);
    }
    const text = (element) => ({ element });
    keyed(this.events, events, (event) => `${event.time_ns}/${event.subject}/${event.what}`, (event) => text(h("li", {}, h("time", {}, time(event.time_ns / 1e9)), ` ${event.subject}: ${event.what} – ${event.why}`)), () => {});
    this.noEvents.hidden = events.length > 0;
    keyed(this.sensorList, sensors, (sensor) => sensor.channel, () => text(h("li")), (part, sensor) => {
      const health = HEALTH[sensor.health];
      part.element.dataset.level = health.level;
      const share = outliers[sensor.channel] ? `, ${percent(outliers[sensor.channel].recent_share)} rejected` : "";
      const distance = nodes[sensor.node]?.distance;
      setText(part.element, `${health.sign} ${this.sensorNames.get(sensor.channel) ?? sensor.channel}: ${health.word}${share}${distance ? `, distance ${number(distance)}` : ""}${compared(sensor.compared)}${offset(sensor.clock)}`);
    });
    keyed(
      this.services,
      services,
      (service) => `${service.service}/${service.id}`,
      () => {
        const cells = Array.from({ length: 5 }, () => h("td"));
        return { element: h("tr", {}, cells), cells };
      },
      ({ cells }, { service, id, present, lag_s, status }) => {
        setText(cells[0], service === id ? service : `${service} ${id}`);
        setText(cells[1], present ? "● alive" : "✕ gone");
        setText(cells[2], lag(lag_s));
        setText(cells[3], status ? String(status.done) : "–");
        setText(cells[4], Object.entries(status?.drops ?? {}).map(([reason, count]) => `${reason} ${count}`).join(", ") || "nothing");
      },
    );
  }

  #take(series) {
    if (!this.about) return;
    const changed = new Set(this.points.take(series));
    for (const plot of this.#plots) {
      if (this.span.isLive && plot.plot.names.some((name) => changed.has(name))) plot.dirty();
    }
  }

  /** Creates plots for new series. */
  #discover(name) {
    const [kind, of] = [name.slice(0, name.indexOf("/")), name.slice(name.indexOf("/") + 1)];
    if (kind === "innovation") {
      const sensor = this.about.drawing.sensors.find((sensor) => sensor.channel === of);
      if (sensor) this.#plot("innovations", of, () => innovationPlot(sensor, this.points, this.span));
    } else if (kind === "consistency") {
      this.#plot("agreement", of, () => consistencyPlot(this.points, this.span));
    } else if (kind === "class") {
      this.classes ??= [];
      if (this.classes.includes(of)) return;
      this.classes.push(of);
      // A new class changes the whole stack.
      const old = this.#made.get("classes/all");
      if (old) {
        this.#drop(old);
        this.#made.delete("classes/all");
      }
      this.#plot("classes", "all", () => classPlot([...this.classes], this.points, this.span));
    }
  }

  #draw() {
    if (document.hidden || !this.ranges) return;
    this.ranges.update();
    this.#plots.forEach((plot) => plot.draw());
  }

  #respan() {
    this.span.keptFrom_s = null;
    this.ranges?.update();
    this.#plots.forEach((plot) => plot.restart());
  }

  /** Scrolls to the parameter in the address and shows its moment. */
  #goto(parameters) {
    const at = Number(parameters.get("at"));
    if (at > 0) this.span.fix(at - AROUND_S, at + AROUND_S);
    const name = parameters.get("parameter");
    const plot = name && document.getElementById(`plot-parameter-${name}`);
    document.querySelectorAll(".plot.is-chosen").forEach((chosen) => chosen.classList.remove("is-chosen"));
    if (plot) {
      plot.classList.add("is-chosen");
      plot.scrollIntoView({ block: "center" });
    }
  }
}

/** Buttons that select the span of all plots. */
class RangeBar {
  constructor(span) {
    this.span = span;
    this.buttons = LENGTHS.map(([length, text]) => {
      const button = h("button", { type: "button", onclick: () => span.live(length) }, text);
      return { length, button };
    });
    this.zoomed = h("button", { type: "button", class: "back", onclick: () => span.live(span.length_s) }, "▶ Back to live");
    this.text = h("span", { class: "range-text", role: "status" });
    this.element = h("div", { class: "ranges", role: "group", "aria-label": "Span of all plots" }, this.buttons.map(({ button }) => button), this.zoomed, this.text);
    this.update();
  }

  update() {
    const { span } = this;
    for (const { length, button } of this.buttons) button.setAttribute("aria-pressed", String(span.isLive && span.length_s === length));
    this.zoomed.hidden = span.isLive;
    setText(this.text, this.#words());
  }

  #words() {
    const { span } = this;
    const kept = span.lacks ? ` · kept since ${time(span.keptFrom_s)}` : "";
    return (span.isLive ? "newest data" : `${time(span.from_s)} – ${time(span.to_s)} (${duration(span.to_s - span.from_s)})`) + kept;
  }
}
