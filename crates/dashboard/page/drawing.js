// The structure and its sensors as described by the structure file, coloured by probability of
// loss.

import { h, s, setAttribute, setText, whole } from "./dom.js";
import { t } from "./language.js";
import { BLIND, HEALTH, STATES, STEPS, isBlind, isOpen, probability, sensorName, step } from "./words.js";

/** Size of the drawing in its own units, and width of a drawing above the table. */
const WIDTH = 420;
const WIDE = 1100;
const HEIGHT = 360;
/** Height below which a structure is wide, as a share of its length. */
const WIDE_BELOW = 0.5;
/** Windows that are too narrow for a wide drawing. The style sheet has the same limit. */
const NARROW = "(max-width: 960px)";
/** Smallest and largest height of a storey, and height of many storeys. */
const LEAST_STOREY = 12;
const MOST_STOREY = 58;
const MOST_STOREYS = 620;
/** Of many storeys without room for their names, each tenth is named. */
const EACH = 10;
/** Smallest width of the storeys, and of the room on each side of them. */
const LEAST_WIDTH = 90;
const LEAST_SIDE = 70;
/** Room above and below the storeys. */
const ROOM = 42;
const BELOW = 26;
/** Width of a character of a name, and height of a name. */
const CHARACTER = 7;
/** Length to which a name beside the storeys is shortened, so that they keep their room. */
const LONGEST = 24;
/** Width of a character of a bold name, as beside a part with a probable loss. */
const BOLD_CHARACTER = 8.2;
const NAME_HEIGHT = 14;
/** Size of the sign of a sensor. */
const SIGN = 12;
const MARGIN = 34;
/** Minimum height of a part for a name inside (in units of the drawing). */
const NAMED_FROM = 13;
/**
 * Distance between the names beside parts that are too small, and distance of the names from the
 * part.
 */
const CALLOUT_ROW = 13;
const CALLOUT_FROM = 20;
/** Room for the probability beside a part, such as > 99.99 %. */
const CALLOUT_SIDE = 90;
/**
 * Probability of loss from which the worst part has a name even if it is too small. The order of
 * sound parts means nothing.
 */
const WORTH_NAMING = 0.05;
/** Minimum height of the drawing. Flatter structures are drawn with exaggerated heights. */
const FLATTEST = 130;
/**
 * Maximum number of parameters that are all named. With more, only parts with a finding are named.
 */
const MOST_NAMES = 12;

export class Drawing {
  #parts = [];
  #sensors = [];
  /** Names beside parts that are too small, and the heights of the other names. */
  #callouts = [];
  #named = [];
  /** Names of sensors beside members, with their edges. */
  #sensorNames = [];

  constructor(about, choose) {
    this.choose = choose;
    const { drawing } = about;
    this.isWide = drawing.form === "members" && isWide(drawing.points);
    this.width = this.isWide && !matchMedia(NARROW).matches ? WIDE : WIDTH;
    this.svg = s("svg", { class: "drawing", role: "img", viewBox: `0 0 ${WIDTH} ${HEIGHT}` });
    this.svg.append(s("title", {}, about.is_filtered ? t("drawing-of-coloured-by-probability-of-loss", about.name) : t("drawing-of-with-its-sensors", about.name)));
    this.svg.append(hatches());
    const parameters = new Set(drawing.members.flatMap((member) => member.parameters));
    this.namesAll = parameters.size <= MOST_NAMES;
    if (drawing.form === "storeys") this.#storeys(drawing);
    else if (drawing.form === "members") this.#members(drawing);
    else this.#boxes(drawing);
    this.element = h("figure", { class: "drawing-figure", hidden: drawing.points.length === 0 }, this.svg, key(about, this.note));
  }

  /**
   * Colours the parts and marks the sensors. A part without a decision, of which the present data say
   * nothing, or whose alert is not confirmed, has no colour.
   */
  update({ losses, sensors, alerts }) {
    const found = new Map();
    const open = new Map(alerts.filter((alert) => isOpen(alert) || isBlind(alert)).map((alert) => [alert.parameter, isBlind(alert) ? "blind" : alert.state]));
    for (const part of this.#parts) {
      const known = part.parameters.flatMap((name) => (open.has(name) ? [] : (losses[name] ?? []))).sort((a, b) => b.probability_of_loss - a.probability_of_loss);
      const worst = known[0]?.probability_of_loss ?? null;
      const states = worst === null ? part.parameters.map((name) => open.get(name)).filter(Boolean) : [];
      const state = states.includes("unconfirmed") ? "unconfirmed" : (states[0] ?? null);
      const told = state ? wordsOf(state) : probability(worst, known[0]?.rule_credibility);
      // An alert that is not confirmed is still worth a name.
      const isFound = (worst !== null && worst >= 0.5) || state === "unconfirmed";
      found.set(part.name, { worst: state === "unconfirmed" ? 1 : worst, told });
      for (const element of [part.element, part.words]) {
        setAttribute(element, "data-open", state);
        setAttribute(element, "data-step", step(worst));
      }
      const names = part.parameters.join(", ") || "known";
      setText(part.title, `${part.name}: ${part.parameters.length === 0 ? names : state ? `${names}, ${told}` : t("part-probability-of-loss", names, told)}`);
      if (part.label) {
        setText(part.label, part.parameters.length === 0 ? "" : this.namesAll || isFound ? part.text(worst === null && !state ? "" : told) : "");
      }
      if (part.value) setText(part.value, isFound ? told : "");
    }
    this.#callOut(found);
    // The probability of a finding is more important than the name of a sensor.
    const values = this.#parts.filter(({ value }) => value?.textContent).map(({ value }) => box(value, value.textContent));
    for (const { name, own } of this.#sensorNames) setAttribute(name, "visibility", values.some((value) => overlap(own, value)) ? "hidden" : null);
    const health = new Map(sensors.map((sensor) => [sensor.channel, sensor.health]));
    for (const { channel, name, element, sign, title } of this.#sensors) {
      const { sign: shape, word, level } = HEALTH[health.get(channel) ?? "unknown"];
      setText(sign, shape);
      setAttribute(element, "data-level", level);
      setText(title, `${name}: ${word}`);
    }
  }

  /**
   * Names the parts that are too small for a name inside: all of few parts, or else those with a probable
   * loss, and the worst part. Only a probable loss is bold and has its probability.
   */
  #callOut(found) {
    const worstOf = ({ names }) => Math.max(...names.map((name) => found.get(name)?.worst ?? 0));
    const most = Math.max(...[...found.values()].map(({ worst }) => worst ?? 0));
    const isFound = (callout) => worstOf(callout) >= Math.min(0.5, Math.max(most, WORTH_NAMING));
    const shown = this.namesAll ? this.#callouts : this.#callouts.filter(isFound);
    for (const callout of this.#callouts) setAttribute(callout.element, "visibility", shown.includes(callout) ? null : "hidden");
    // Places callouts from the lowest part upwards, each at its part or at the next free height.
    const taken = [...this.#named];
    for (const callout of shown.toSorted((a, b) => b.y - a.y)) {
      const { names, text, value, leader, y, edge } = callout;
      const isFree = (height) => taken.every((other) => Math.abs(other - height) >= CALLOUT_ROW);
      let height = y;
      while (!isFree(height) && height > CALLOUT_ROW) height -= 1;
      taken.push(height);
      const worst = names.map((one) => found.get(one)).sort((a, b) => (b?.worst ?? 0) - (a?.worst ?? 0))[0];
      setText(value, isFound(callout) ? (worst?.told ?? "") : "");
      setAttribute(text, "class", isFound(callout) ? "callout" : "aside");
      for (const one of [text, value]) one.setAttribute("y", height);
      leader.setAttribute("d", `M${edge - CALLOUT_FROM + 3} ${height}L${edge - 6} ${y}H${edge}`);
    }
  }

  #storeys({ members, points, sensors }) {
    const storey = Math.min(MOST_STOREY, Math.max((HEIGHT - ROOM) / members.length, Math.min(LEAST_STOREY, MOST_STOREYS / members.length)));
    const bottom = storey * members.length + ROOM - BELOW;
    this.svg.setAttribute("viewBox", `0 0 ${WIDTH} ${bottom + BELOW}`);
    const abreast = Math.max(0, ...points.map((_, point) => sensors.filter((sensor) => sensor.point === point).length));
    // The storeys are as wide as the names on both sides permit.
    const longest = (texts, character) => Math.max(0, ...texts.map((text) => text.length)) * character;
    const left = Math.max(LEAST_SIDE, longest(members.filter(({ parameters }) => parameters.length > 0).map(({ parts }) => short(parts[0])), BOLD_CHARACTER) + CALLOUT_FROM + 4);
    const beside = storey >= NAMED_FROM ? longest(points.map((_, point) => namesAt(sensors, point)), CHARACTER) : 0;
    const group = (member) => members.filter((other) => other.parts[0] === member.parts[0]);
    const isSmall = (member) => group(member).length * storey < NAMED_FROM;
    const side = members.some((member) => member.parameters.length > 0 && isSmall(member)) ? CALLOUT_SIDE : LEAST_SIDE;
    const width = Math.max(LEAST_WIDTH, WIDTH - left - Math.max(side, beside + 20) - 15 * abreast);
    const level = (point) => bottom - storey * points[point].y;
    this.svg.append(s("path", { class: "ground", d: `M${left - 20} ${bottom}H${left + width + 6}` }), ...ground(left - 20, left + width + 6, bottom));
    const names = [];
    /** Returns the distance of the name of storeys from their middle, which is a floor if their number is even. */
    const offFloor = (together) => (together.length % 2 === 0 ? storey / 2 : 0);
    for (const first of members.filter((member) => group(member)[0] === member && member.parameters.length > 0)) {
      const together = group(first);
      const y = (level(first.ends[0]) + level(together.at(-1).ends[1])) / 2;
      if (!isSmall(first)) {
        this.#named.push(y - offFloor(together));
        continue;
      }
      const text = s("text", { x: left - CALLOUT_FROM, class: "callout", "dominant-baseline": "central" }, short(first.parts[0]));
      // To the right of the sensors.
      const isTenth = !this.namesAll && members.indexOf(first) % EACH === EACH - 1;
      if (isTenth) {
        this.#named.push(y);
        names.push(s("text", { x: left - 10, y, class: "aside sensor-name", "dominant-baseline": "central" }, first.parts[0]));
      }
      const value = s("text", { x: left + width + 14 + 15 * abreast, class: "callout beside", "dominant-baseline": "central" });
      const leader = s("path", { class: "leader" });
      const element = s("g", { visibility: "hidden", "data-callout": first.parts[0] }, leader, text, value);
      this.#callouts.push({ element, text, value, leader, y, edge: left, names: together.map((member) => member.parts.join(", ")) });
    }
    const floors = [];
    for (const member of members) {
      const [y0, y1] = member.ends.map(level);
      const shape = { x: left, y: Math.min(y0, y1), width, height: Math.abs(y0 - y1) };
      const together = group(member);
      // Storeys that are scaled together have one name.
      const isNamed = together[0] === member && member.parameters.length > 0 && together.length * storey >= NAMED_FROM;
      const middle = (y0 + level(together.at(-1).ends[1])) / 2 - offFloor(together);
      const label = isNamed ? s("text", { x: left + width / 2, y: middle, class: "inside", "dominant-baseline": "central" }) : null;
      const name = isNamed ? s("text", { x: left - 10, y: middle, class: "aside", "dominant-baseline": "central" }, short(member.parts[0])) : null;
      this.#part(member, [s("rect", { ...shape, class: "fill" }), s("rect", { ...shape, class: "hatch" })], { label, text: (told) => told, name });
      floors.push(s("path", { class: storey >= NAMED_FROM || together.at(-1) === member ? "floor" : "floor thin", d: `M${left} ${y1}H${left + width}` }));
    }
    // Texts are in front of the floors, so that no line crosses them.
    this.svg.append(...floors, ...names, ...this.#parts.map(({ words }) => words));
    this.svg.append(...this.#callouts.map(({ element }) => element));
    this.#placeSensors(sensors, (point, count) => [left + width + 16 + 15 * count, level(point)], storey >= NAMED_FROM ? 1 : 0);
  }

  #members({ points, members, sensors }) {
    const xs = points.map((point) => point.x);
    const ys = points.map((point) => point.y);
    const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const scale = Math.min((this.width - 2 * MARGIN) / (x1 - x0 || 1), (HEIGHT - 2 * MARGIN) / (y1 - y0 || 1));
    const lying = (y1 - y0) * scale;
    const upwards = lying > 0 && lying < FLATTEST ? (scale * FLATTEST) / lying : scale;
    if (upwards > 1.5 * scale) this.note = t("heights-are-drawn-times-larger-than-lengths", (upwards / scale).toFixed(0));
    const height = Math.min(HEIGHT, (y1 - y0) * upwards + 2 * MARGIN + 20);
    this.svg.setAttribute("viewBox", `0 0 ${this.width} ${height}`);
    const at = ({ x, y }) => [this.width / 2 + (x - (x0 + x1) / 2) * scale, height / 2 - (y - (y0 + y1) / 2) * upwards];
    for (const point of points.filter((point) => point.held)) {
      const [x, y] = at(point);
      this.svg.append(s("path", { class: "support", d: `M${x} ${y}l-7 11h14z` }));
    }
    const named = new Set();
    const labels = [];
    const taken = [];
    for (const member of members) {
      const [from, to] = member.ends.map((end) => at(points[end]));
      const d = `M${from}L${to}`;
      const name = member.parameters.join(", ");
      let [label, value] = [null, null];
      if (name && !named.has(name)) {
        named.add(name);
        const own = members.filter((other) => other.parameters.join(", ") === name).flatMap((other) => other.ends.map((end) => at(points[end])));
        const [x, y] = [0, 1].map((axis) => own.reduce((sum, one) => sum + one[axis], 0) / own.length);
        const isUpright = Math.abs(from[0] - to[0]) < Math.abs(from[1] - to[1]);
        label = s("text", { x: isUpright ? x + 10 : x, y: isUpright ? y + 20 : y - 12, class: isUpright ? "beside" : "above" });
        // Below the name, so that it does not cover the name of the next part.
        value = s("text", { x: label.getAttribute("x"), y: Number(label.getAttribute("y")) + (isUpright ? NAME_HEIGHT : 2 * NAME_HEIGHT + 4), class: label.getAttribute("class") });
        labels.push(label, value);
        taken.push(box(label, name));
      }
      this.#part(member, [s("path", { class: "grip", d }), s("path", { class: "line", d }), s("path", { class: "dash", d })], { label, value, text: () => name });
    }
    this.#placeSensors(sensors, (point, count) => {
      const [x, y] = at(points[point]);
      return [x + 12 * count, y];
    }, 0);
    this.svg.append(...labels);
    const lines = members.flatMap(({ ends }) => along(at(points[ends[0]]), at(points[ends[1]])));
    const signs = sensors.filter(({ point }) => point !== null).map(({ point }, index, all) => {
      const [x, y] = at(points[point]);
      return around(x + 12 * all.slice(0, index).filter((other) => other.point === point).length, y, SIGN / 2);
    });
    this.#nameSensors(sensors, (point) => at(points[point]), [...taken, ...lines, ...signs], height);
  }

  /** Names the sensors of each point where there is room beside it. */
  #nameSensors(sensors, at, taken, height) {
    const drawn = [...new Set(sensors.map(({ point }) => point).filter((point) => point !== null))];
    for (const point of drawn) {
      const here = sensors.filter((sensor) => sensor.point === point);
      const text = here.map(({ channel }) => channel).join(", ");
      const [x, y] = at(point);
      const right = x + 12 * (here.length - 1) + 12;
      const places = [[x + 9, y + 18, "beside"], [right, y, "beside"], [x - 12, y, "aside"], [x - 9, y + 18, "aside"], [right, y - 16, "beside"]];
      for (const [left, top, side] of places) {
        const name = s("text", { x: left, y: top, class: `${side} sensor-name`, "dominant-baseline": "central" }, text);
        const own = box(name, text);
        const isInside = own.left >= 0 && own.right <= this.width && own.bottom <= height;
        if (!isInside || taken.some((other) => overlap(own, other))) continue;
        taken.push(own);
        this.#sensorNames.push({ name, own });
        this.svg.append(name);
        break;
      }
    }
  }

  #boxes({ points, members, sensors }) {
    const width = Math.min(120, (WIDTH - 20) / points.length - 8);
    const left = (index) => 10 + index * (width + 8);
    this.svg.setAttribute("viewBox", `0 0 ${WIDTH} 150`);
    this.note = t("substructures-without-geometry-side-by-side");
    for (const member of members) {
      const x = left(member.ends[0]);
      const shape = { x, y: 40, width, height: 60 };
      const label = s("text", { x: x + width / 2, y: 70, class: "inside", "dominant-baseline": "central" });
      const name = s("text", { x: x + width / 2, y: 30, class: "over" }, member.parts.join(", "));
      this.#part(member, [s("rect", { ...shape, class: "fill" }), s("rect", { ...shape, class: "hatch" })], { label, text: (told) => told, name });
    }
    this.svg.append(...this.#parts.map(({ words }) => words));
    this.#placeSensors(sensors, (point, count) => [left(point) + 10 + 16 * count, 118], 0);
  }

  /**
   * Adds a part. `label` shows `text` of its probability, `value` shows the probability of a finding,
   * and `name` does not change.
   */
  #part(member, shapes, { label, text, name = null, value = null }) {
    const title = s("title", {});
    const parameter = member.parameters[0];
    const element = s("g", { class: parameter ? "part" : "part known", "data-part": member.parts.join(" ") }, title, shapes);
    const words = s("g", { class: "words" }, name, label);
    if (parameter) for (const one of [element, words]) one.addEventListener("click", () => this.choose(parameter));
    this.#parts.push({ element, words, title, label, value, text, name: member.parts.join(", "), parameters: member.parameters });
    this.svg.append(element);
  }

  #placeSensors(sensors, place, named) {
    const counts = new Map();
    for (const sensor of sensors.filter((sensor) => sensor.point !== null)) {
      const count = counts.get(sensor.point) ?? 0;
      counts.set(sensor.point, count + 1);
      const [x, y] = place(sensor.point, count);
      const sign = s("text", { x, y, class: "sign", "dominant-baseline": "central" });
      const title = s("title", {});
      const isLast = sensors.filter((other) => other.point === sensor.point).length === count + 1;
      const name = named && isLast ? s("text", { x: x + 12, y, class: "beside", "dominant-baseline": "central" }, namesAt(sensors, sensor.point)) : null;
      const element = s("g", { class: "sensor" }, title, sign, name);
      this.#sensors.push({ channel: sensor.channel, name: sensorName(sensor), element, sign, title });
      this.svg.append(element);
    }
  }
}

/** Returns a name, shortened if it is long. The title of its element has all of it. */
function short(name) {
  return name.length > LONGEST ? `${name.slice(0, LONGEST - 1)}…` : name;
}

/** Returns the names of the sensors at a point, shortened. */
function namesAt(sensors, point) {
  return short(sensors.filter((sensor) => sensor.point === point).map(({ channel }) => channel).join(", "));
}

function isWide(points) {
  const extent = (axis) => Math.max(...points.map((point) => point[axis])) - Math.min(...points.map((point) => point[axis]));
  return extent("y") < WIDE_BELOW * extent("x");
}

function around(x, y, size) {
  return { left: x - size, right: x + size, top: y - size, bottom: y + size };
}

/** Returns small boxes along a line, which texts avoid. */
function along([x0, y0], [x1, y1]) {
  const count = Math.max(1, Math.ceil(Math.hypot(x1 - x0, y1 - y0) / SIGN));
  return Array.from({ length: count + 1 }, (_, index) => around(x0 + ((x1 - x0) * index) / count, y0 + ((y1 - y0) * index) / count, 2));
}

/** Returns the approximate edges of a text, before it is in the document. */
function box(element, text) {
  const [x, y] = ["x", "y"].map((name) => Number(element.getAttribute(name)));
  const width = CHARACTER * text.length;
  const names = element.getAttribute("class");
  const left = names.includes("above") ? x - width / 2 : names.includes("aside") ? x - width : x;
  return { left, right: left + width, top: y - NAME_HEIGHT / 2, bottom: y + NAME_HEIGHT / 2 };
}

function overlap(a, b) {
  return a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
}

/** Creates the hatching of parts with a probable loss, which shows the loss without colour. */
function hatches() {
  const pattern = (id, distance) =>
    s("pattern", { id, width: distance, height: distance, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" }, s("path", { d: `M0 0V${distance}`, class: "hatch-line" }));
  return s("defs", {}, pattern("hatch-2", 10), pattern("hatch-3", 6));
}

function ground(from, to, y) {
  const count = Math.floor((to - from) / 12);
  return Array.from({ length: count }, (_, index) => s("path", { class: "ground", d: `M${from + 12 * index + 8} ${y}l-7 8` }));
}

/** Returns sign and word of the state of a part without a finding. */
function wordsOf(state) {
  const { sign, word } = state === "blind" ? BLIND : STATES[state];
  return `${sign} ${word}`;
}

function key({ drawing: { sensors }, has_model: hasModel, is_filtered: isFiltered }, note) {
  const swatch = (index, open = null) => s("svg", { class: "swatch", viewBox: "0 0 22 14", "aria-hidden": "true" }, s("g", { class: "part", "data-step": index, "data-open": open }, s("rect", { class: "fill", width: 22, height: 14 }), s("rect", { class: "hatch", width: 22, height: 14 })));
  const steps = STEPS.map((one, index) => h("li", {}, swatch(index), one.text));
  for (const state of ["undecided", "unconfirmed", "blind"]) steps.push(h("li", {}, swatch("", state), wordsOf(state)));
  const apart = sensors.filter((sensor) => sensor.point === null).map((sensor) => sensor.channel);
  return h(
    "figcaption",
    { class: "drawing-key" },
    isFiltered ? [h("span", {}, t("key-probability-of-loss")), h("ul", {}, steps)] : null,
    // A sign stays on the line of its word.
    h("span", {}, t("sensors-delivers-gone-or-silent-faulty-excluded").split("  ").flatMap((one) => [whole(one), " "])),
    h("span", {}, hasModel && !isFiltered ? t("not-coloured") : null, note, apart.length > 0 ? t("not-drawn", apart.join(", ")) : null),
  );
}
