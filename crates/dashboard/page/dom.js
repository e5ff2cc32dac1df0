// Creates elements. Text is always set as text, because names and sentences come from outside.

const SVG = "http://www.w3.org/2000/svg";
/** A date or a name with hyphens, a number with its standard deviation, or one with its unit. */
const UNBROKEN = /\S*[^\s-]-\S+|[\d.,]+ ± [\d.,]+\S*|\S*[\d.,]+ (?:%|(?:ms|s|min|h|Hz)(?![\p{L}\d]))\S*/gu;
/** Length up to which a name fits a line of a phone, and does not break. */
const LONGEST = 22;

/**
 * Returns a text as nodes in which no short name breaks at a hyphen, and no unit leaves its number. The
 * text itself stays the same, so that it can be searched and copied.
 */
export function unbroken(text) {
  const pieces = [];
  let end = 0;
  for (const { 0: piece, index } of text.matchAll(UNBROKEN)) {
    if (piece.length > LONGEST) continue;
    pieces.push(text.slice(end, index), whole(piece));
    end = index + piece.length;
  }
  return [...pieces, text.slice(end)].filter((piece) => piece !== "");
}

/** Returns a text that does not break at the end of a line. */
export function whole(text) {
  return fill(document.createElement("span"), { class: "whole" }, [text]);
}

/** Returns the nodes of a text as one child, because each child of a flexible box is placed on its own. */
function child(text) {
  const pieces = unbroken(text);
  return pieces.length > 1 ? fill(document.createElement("span"), {}, pieces) : (pieces[0] ?? "");
}

function fill(element, properties, children) {
  for (const [name, value] of Object.entries(properties ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value") element.value = value;
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Creates an HTML element. An option contains only text. */
export function h(tag, properties, ...children) {
  const placed = children.flat().map((one) => (typeof one === "string" && tag !== "option" ? child(one) : one));
  return fill(document.createElement(tag), properties, placed);
}

/** Creates an SVG element. */
export function s(tag, properties, ...children) {
  return fill(document.createElementNS(SVG, tag), properties, children);
}

/**
 * Sets a text only if it has changed. Otherwise a selection would be lost, or a screen reader would
 * repeat the text.
 */
export function setText(element, text) {
  if (element.textContent === text) return;
  if (element instanceof HTMLElement) element.replaceChildren(child(text));
  else element.textContent = text;
}

/** Sets an attribute if it has changed; null removes it. */
export function setAttribute(element, name, value) {
  if (value === null) element.removeAttribute(name);
  else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
}

/** Returns the items in groups with the same key, in the order of their first items. */
export function grouped(items, key) {
  const groups = new Map();
  for (const item of items) groups.set(key(item), [...(groups.get(key(item)) ?? []), item]);
  return [...groups.values()];
}

/**
 * Keeps one child per item, in the order of the items. Moves and updates existing children, creates
 * new ones and removes others.
 */
export function keyed(parent, items, key, make, update) {
  parent.parts ??= new Map();
  const wanted = new Set(items.map(key));
  for (const [name, part] of parent.parts) {
    if (!wanted.has(name)) {
      part.element.remove();
      parent.parts.delete(name);
    }
  }
  let before = null;
  for (const item of items) {
    const name = key(item);
    if (!parent.parts.has(name)) parent.parts.set(name, make(item));
    const part = parent.parts.get(name);
    update(part, item);
    const place = before ? before.nextSibling : parent.firstChild;
    if (place !== part.element) parent.insertBefore(part.element, place);
    before = part.element;
  }
}
