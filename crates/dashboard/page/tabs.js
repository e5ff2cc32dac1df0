// Tabs, operated by mouse and keyboard. Only the chosen panel is visible.

import { h } from "./dom.js";

export class Tabs {
  /** `tabs` have a `key`, a `title` and an `element`. `choose` receives the key of a tab. */
  constructor(tabs, label, choose) {
    this.tabs = tabs.map((tab, index) => {
      const button = h("button", { type: "button", role: "tab", id: `tab-${tab.key}`, "aria-controls": `panel-${tab.key}`, onclick: () => choose(tab.key), onkeydown: (event) => this.#key(event, index) }, tab.title);
      const panel = h("div", { role: "tabpanel", id: `panel-${tab.key}`, "aria-labelledby": `tab-${tab.key}`, tabindex: "0", hidden: true }, tab.element);
      return { ...tab, button, panel };
    });
    this.choose = choose;
    this.list = h("div", { class: "tabs", role: "tablist", "aria-label": label }, this.tabs.map(({ button }) => button));
    this.panels = this.tabs.map(({ panel }) => panel);
    // A turned phone has another width.
    new ResizeObserver(() => this.#scroll()).observe(this.list);
  }

  /** Shows the panel of a tab. */
  show(key) {
    for (const { key: own, button, panel } of this.tabs) {
      button.setAttribute("aria-selected", String(own === key));
      button.tabIndex = own === key ? 0 : -1;
      panel.hidden = own !== key;
    }
    this.#scroll();
  }

  /** Scrolls to the chosen tab. On a phone, the tabs are wider than the window. */
  #scroll() {
    const button = this.tabs.find(({ button }) => button.tabIndex === 0)?.button;
    if (button) this.list.scrollLeft = button.offsetLeft - this.list.offsetLeft - (this.list.clientWidth - button.clientWidth) / 2;
  }

  #key(event, index) {
    const last = this.tabs.length - 1;
    const next = { ArrowLeft: index === 0 ? last : index - 1, ArrowRight: index === last ? 0 : index + 1, Home: 0, End: last }[event.key];
    if (next === undefined || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    this.choose(this.tabs[next].key);
    this.tabs[next].button.focus();
  }
}
