// A plain map of the structures whose files state coordinates. It needs no other server: it shows a grid
// of latitudes and longitudes, a scale, and a sign for each structure.

import { h, s } from "./dom.js";
import { fixed, t } from "./language.js";
import { attentionWords } from "./words.js";

/** Smallest number of structures with coordinates for which a map is useful. */
const FEWEST = 2;
/** Smallest and largest height of the map, and room at its edges (px). */
const [LOWEST, HIGHEST] = [180, 420];
const ROOM = { x: 90, y: 48 };
/** Smallest extent of the map (degrees of latitude, about 1 km). */
const LEAST_EXTENT = 0.01;
/** Length of a degree of latitude (km). */
const KM_PER_DEGREE = 111.2;
/** Radius of a sign, height of a name, and width of a character (px). */
const [RADIUS, NAME, CHARACTER] = [10, 15, 8.2];
/** Possible distances of the lines of the grid (degrees), and smallest distance on the screen (px). */
const GRID = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30];
const GRID_FROM = 110;
/** Screens on which the map is folded at first. */
const NARROW = "(max-width: 760px)";
/** Levels whose structures have a name also above the signs of others, but not above those of these levels. */
const NAMED = ["alarm", "stale", "warning"];

export class StructureMap {
  #known = "";

  constructor() {
    this.svg = s("svg", { class: "map-drawing", role: "group", "aria-label": t("map-of-the-structures") });
    this.element = h("details", { class: "card map", open: !matchMedia(NARROW).matches, hidden: true }, h("summary", {}, t("map")), this.svg);
    this.resized = new ResizeObserver(() => this.#draw());
    this.resized.observe(this.element);
  }

  close() {
    this.resized.disconnect();
  }

  /** Shows the structures with coordinates, the most urgent first. */
  show(structures) {
    this.structures = structures.filter(({ coordinates }) => coordinates);
    this.element.hidden = this.structures.length < FEWEST;
    const known = JSON.stringify(this.structures.map(({ name, level, coordinates, sentence }) => [name, level, coordinates, sentence]));
    if (known === this.#known) return;
    this.#known = known;
    this.#draw();
  }

  #draw() {
    const width = this.svg.clientWidth;
    if (!this.structures || this.element.hidden || width === 0) return;
    const focused = this.svg.contains(document.activeElement) ? document.activeElement.dataset.name : null;
    const view = projection(this.structures.map(({ coordinates }) => coordinates), width);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${view.height}`);
    this.svg.style.height = `${view.height}px`;
    const sites = apart(this.structures.map((structure) => ({ structure, ...view.place(structure.coordinates) })), width, view.height);
    const names = placeNames(sites, width);
    // The most urgent structure is drawn last, so that it is above the others.
    this.svg.replaceChildren(...grid(view, width), ...sites.map((site, index) => sign(site, names[index])).toReversed());
    if (focused) [...this.svg.querySelectorAll("a")].find(({ dataset }) => dataset.name === focused)?.focus();
  }
}

/** Returns how coordinates are placed on a map of a width (px): equal distances north and east. */
function projection(all, width) {
  const latitudes = all.map(({ latitude }) => latitude);
  const [south, north] = [Math.min(...latitudes), Math.max(...latitudes)];
  const west = westOf(all.map(({ longitude }) => longitude));
  const eastOf = (longitude) => (longitude - west + 360) % 360;
  const east = Math.max(...all.map(({ longitude }) => eastOf(longitude)));
  const middle = (south + north) / 2;
  // At a pole, all longitudes are at one place.
  const squeeze = Math.max(Math.cos((middle * Math.PI) / 180), 0.01);
  const [across, up] = [Math.max(east * squeeze, LEAST_EXTENT), Math.max(north - south, LEAST_EXTENT)];
  const inner = Math.max(width - 2 * ROOM.x, 60);
  const scale = Math.min(inner / across, (HIGHEST - 2 * ROOM.y) / up);
  const height = Math.max(LOWEST, up * scale + 2 * ROOM.y);
  const x = (degrees) => width / 2 + (degrees - east / 2) * squeeze * scale;
  const y = (latitude) => height / 2 - (latitude - middle) * scale;
  return { west, middle, squeeze, scale, height, x, y, place: ({ latitude, longitude }) => ({ x: x(eastOf(longitude)), y: y(latitude) }) };
}

/** Returns the western edge for which the structures take the fewest degrees: east of the widest gap. */
function westOf(longitudes) {
  const sorted = [...longitudes].sort((a, b) => a - b);
  const gaps = sorted.map((longitude, index) => ({ longitude, gap: index > 0 ? longitude - sorted[index - 1] : longitude + 360 - sorted.at(-1) }));
  return gaps.reduce((widest, one) => (one.gap > widest.gap ? one : widest)).longitude;
}

/** Rounds in which overlapping signs move apart. A crowd that needs more remains close. */
const ROUNDS = 20;

/** Moves signs that overlap apart, so that each state is visible. The place of each remains in `from`. */
function apart(sites, width, height) {
  const moved = sites.map(({ x, y, ...site }) => ({ ...site, x, y, from: { x, y } }));
  const near = 2 * RADIUS + 2;
  for (let round = 0, isClose = true; isClose && round < ROUNDS; round += 1) {
    isClose = false;
    moved.forEach((one, index) => moved.slice(index + 1).forEach((other) => {
      const [right, down] = [other.x - one.x, other.y - one.y];
      const distance = Math.hypot(right, down);
      if (distance >= near - 0.01) return;
      isClose = true;
      // Signs at the same place move sideways.
      const [x, y] = distance > 0 ? [right / distance, down / distance] : [1, 0];
      const step = (near - distance) / 2;
      [one.x, one.y, other.x, other.y] = [one.x - step * x, one.y - step * y, other.x + step * x, other.y + step * y];
    }));
  }
  const inside = (value, most) => Math.min(Math.max(value, RADIUS + 2), most - RADIUS - 2);
  return moved.map((site) => ({ ...site, x: inside(site.x, width), y: inside(site.y, height) }));
}

/** Draws the lines of latitude and longitude with their degrees, and the scale. */
function grid({ west, middle, squeeze, scale, height, x, y }, width) {
  const distance = (pixels) => GRID.find((step) => step * pixels >= GRID_FROM) ?? GRID.at(-1);
  const [up, across] = [distance(scale), distance(scale * squeeze)];
  const words = (degrees, step, [plus, minus]) => `${fixed(Math.abs(degrees), Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))}°${degrees % 180 === 0 ? "" : ` ${degrees < 0 ? minus : plus}`}`;
  const parts = [];
  for (let index = Math.ceil((middle - height / 2 / scale) / up); index * up <= middle + height / 2 / scale; index += 1) {
    if (Math.abs(index * up) > 90) continue;
    parts.push(s("line", { x1: 0, x2: width, y1: y(index * up), y2: y(index * up) }), s("text", { x: 6, y: y(index * up) - 4 }, words(index * up, up, "NS")));
  }
  const [left, right] = [0, width].map((pixel) => west + (pixel - x(0)) / squeeze / scale);
  for (let index = Math.ceil(left / across); index * across <= right; index += 1) {
    const place = x(index * across - west);
    const longitude = ((index * across + 540) % 360) - 180;
    parts.push(s("line", { x1: place, x2: place, y1: 0, y2: height }), s("text", { x: place + 4, y: 14 }, words(longitude, across, "EW")));
  }
  const km = [1, 2, 5].flatMap((digit) => [-2, -1, 0, 1, 2, 3].map((power) => digit * 10 ** power)).sort((a, b) => a - b).findLast((km) => (km / KM_PER_DEGREE) * scale <= width / 4);
  const length = km === undefined ? 0 : (km / KM_PER_DEGREE) * scale;
  const from = width - 14 - length;
  const bar = s("path", { class: "scale", d: `M${from} ${height - 18}v6h${length}v-6` });
  const told = km < 1 ? `${1000 * km} m` : `${km} km`;
  return [s("g", { class: "graticule", "aria-hidden": "true" }, ...parts), ...(length > 0 ? [s("g", { class: "graticule", "aria-hidden": "true" }, bar, s("text", { x: from + length / 2, y: height - 18, "text-anchor": "middle" }, told))] : [])];
}

/**
 * Returns a place for the name of each structure: right, left, above or below its sign, or null without
 * room. The sites are in the order of their urgency.
 */
function placeNames(sites, width) {
  const signs = sites.map(({ x, y }) => ({ left: x - RADIUS, right: x + RADIUS, top: y - RADIUS, bottom: y + RADIUS }));
  const urgent = signs.filter((_, index) => NAMED.includes(sites[index].structure.level));
  const names = [];
  return sites.map(({ x, y, structure }) => {
    const length = CHARACTER * structure.name.length;
    const at = (left, top) => ({ left, right: left + length, top, bottom: top + NAME });
    const choices = [at(x + RADIUS + 4, y - NAME / 2), at(x - RADIUS - 4 - length, y - NAME / 2), at(x - length / 2, y - RADIUS - NAME - 2), at(x - length / 2, y + RADIUS + 2)];
    const isFree = (box, taken) => box.left >= 0 && box.right <= width && taken.every((other) => box.left >= other.right || box.right <= other.left || box.top >= other.bottom || box.bottom <= other.top);
    const free = choices.find((box) => isFree(box, [...signs, ...names]));
    const overOthers = () => (NAMED.includes(structure.level) ? choices.find((box) => isFree(box, [...urgent, ...names])) : null);
    // An alarm always has a name.
    const box = free ?? overOthers() ?? (structure.level === "alarm" ? choices.find((box) => isFree(box, names)) : null) ?? null;
    if (box) names.push(box);
    return box;
  });
}

/** Draws a structure as a link to its page. Its name is shown if there is room, or on focus. */
function sign({ structure, x, y, from }, box) {
  const { name, level, sentence } = structure;
  const { sign: shape, word } = attentionWords(structure);
  const place = box ?? { left: x + RADIUS + 4, top: y - NAME / 2 };
  const words = `${name}: ${word}. ${sentence}`;
  return s(
    "a",
    { href: `#/structure/${encodeURIComponent(name)}`, class: box ? "site" : "site is-crowded", "data-level": level, "data-name": name, "aria-label": words },
    s("title", {}, words),
    from.x === x && from.y === y ? null : s("path", { class: "site-place", d: `M${from.x} ${from.y}L${x} ${y}` }),
    s("circle", { cx: x, cy: y, r: RADIUS }),
    s("text", { class: "site-sign", x, y: y + 4 }, shape),
    s("text", { class: "site-name", x: place.left, y: place.top + NAME - 3 }, name),
  );
}
