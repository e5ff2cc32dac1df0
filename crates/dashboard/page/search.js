// A search field for names. It exists only where there are many of them.

import { h } from "./dom.js";
import { SEARCH_ABOVE } from "./words.js";

/**
 * Creates a search field for `count` names, with the text of the address if there is one.
 *
 * `element` is null if there are few names. `finds(name)` returns whether a name contains all of
 * the entered words. `enter(text)` replaces them without calling `changed()`.
 */
export function searchField(count, label, changed, text = "") {
  const input = count > SEARCH_ABOVE ? h("input", { type: "search", class: "search", "aria-label": label, placeholder: label, value: text, oninput: () => changed() }) : null;
  const words = () => (input?.value ?? "").toLowerCase().split(/\s+/).filter(Boolean);
  const enter = (text) => input && (input.value = text);
  return { element: input, enter, text: () => input?.value ?? "", finds: (name) => words().every((word) => name.toLowerCase().includes(word)) };
}
