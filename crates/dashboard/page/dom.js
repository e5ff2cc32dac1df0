// Creates elements. Text is always set as text, because names and sentences come from outside.

const SVG = "http://www.w3.org/2000/svg";

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

/** Creates an HTML element. */
export function h(tag, properties, ...children) {
  return fill(document.createElement(tag), properties, children);
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
  if (element.textContent !== text) element.textContent = text;
}

/** Sets an attribute if it has changed; null removes it. */
export function setAttribute(element, name, value) {
  if (value === null) element.removeAttribute(name);
  else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
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
