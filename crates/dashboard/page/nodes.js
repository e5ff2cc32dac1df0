// The nodes in distributed identification, one row per node, as the station reports them.

import { h, keyed, setText } from "./dom.js";
import { t } from "./language.js";
import { NODES, bytes, distanceWords, percent, setSentence, time } from "./words.js";

const HEADS = [t("node"), t("state"), t("distance-limit"), t("excluded-since"), t("last-message"), t("sent-by-node"), t("sent-to-node")];

export class NodeTable {
  constructor() {
    this.rows = h("tbody");
    const heads = h("tr", {}, HEADS.map((text) => h("th", { scope: "col" }, text)));
    // Makes the scrollable area accessible by keyboard.
    const scroll = { class: "scroll", tabindex: "0", role: "region", "aria-label": t("nodes") };
    this.element = h("div", { class: "card" }, h("div", scroll, h("table", { class: "nodes" }, h("thead", {}, heads), this.rows)));
  }

  /**
   * Shows `nodes` (by name, as the station reports them) in the order of `names` in the structure
   * file.
   */
  update(names, nodes) {
    const make = () => {
      const cells = HEADS.map((text, column) => (column === 0 ? h("th", { scope: "row" }) : h("td", { class: column >= 2 ? "number" : null, "data-head": text })));
      return { element: h("tr", {}, cells), cells };
    };
    // Trouble first, otherwise the order of the structure file.
    const isSound = (name) => Number(NODES[nodes[name].state].level !== "warning");
    keyed(this.rows, names.filter((name) => nodes[name]).sort((a, b) => isSound(a) - isSound(b)), (name) => name, make, (row, name) => this.#fill(row, nodes[name]));
  }

  #fill({ element, cells }, node) {
    const state = NODES[node.state];
    const seconds = (time_ns) => (time_ns === null ? "–" : time(time_ns / 1e9));
    const since = node.state === "silent" && node.silent_since_ns !== null ? t("since", seconds(node.silent_since_ns)) : "";
    const share = node.excluded_share > 0.005 ? t("recently", percent(node.excluded_share, 0)) : "";
    element.dataset.level = state.level;
    element.dataset.node = node.node;
    setText(cells[0], node.node);
    setText(cells[1], `${state.sign} ${state.word}${since}`);
    const counts = node.weight !== null && node.weight > 0 && node.weight < 1 ? t("weight", percent(node.weight, 0)) : "";
    setText(cells[2], node.distance === null ? "–" : `${distanceWords(node.distance)}${node.distance_limit === null ? "" : ` (${distanceWords(node.distance_limit)})`}${counts}`);
    setSentence(cells[3], `${seconds(node.excluded_since_ns)}${share}`);
    setText(cells[4], seconds(node.heard_ns));
    setText(cells[5], bytes(node.bytes_received));
    setText(cells[6], bytes(node.bytes_sent));
  }
}
