// The address of the page of a structure: the tab, the chosen parameter and the time span.

/** Decimals of a time in the address (ms). */
const DECIMALS = 3;
/** Time shown on each side of a moment that a link leads to (s). */
export const AROUND_S = 60;

/** Returns the address of a structure's page, optionally with a parameter and a moment. */
export function place(structure, parameter, seconds) {
  const query = new URLSearchParams();
  if (parameter) query.set("parameter", parameter);
  if (seconds) query.set("at", seconds.toFixed(DECIMALS));
  return address(structure, parameter ? "parameters" : null, query);
}

/** Returns the address of the table of a structure's sensors. */
export function sensorsOf(structure) {
  return address(structure, "sensors", new URLSearchParams());
}

/** Returns the address of the waveforms of a structure over a range, with the details of a sensor. */
export function waveformsOf(structure, from_s, to_s, sensor = null) {
  const range = { from: from_s.toFixed(DECIMALS), to: to_s.toFixed(DECIMALS) };
  return address(structure, "sensors", new URLSearchParams(sensor ? { ...range, sensor } : range));
}

/** Returns the address of the year of a judged quantity. */
export function judged(structure, quantity) {
  return address(structure, "lasting", new URLSearchParams({ quantity }));
}

/**
 * Returns the address of the report of some structures over a period, or over the newest `length_s`,
 * with a search among all structures.
 */
export function reportOf(structures, { from_s, to_s, length_s, find }) {
  const period = length_s ? { span: length_s } : { from: from_s.toFixed(DECIMALS), to: to_s.toFixed(DECIMALS) };
  const query = new URLSearchParams({ structures: structures.join(","), ...period });
  if (find) query.set("find", find);
  return `#/report?${query}`;
}

/**
 * Writes the filters of a page into its address, so that a reload, a bookmark and the way back show the
 * same. Filters without a value are left out.
 */
export function rememberFilters(path, filters) {
  const query = new URLSearchParams(Object.entries(filters).filter(([, value]) => value)).toString();
  history.replaceState(null, "", `#/${path}${query ? `?${query}` : ""}`);
}

/**
 * Returns the address of what a structure's page shows now. `more` contains what only this tab states;
 * empty texts are left out.
 */
export function addressOf({ structure, tab, parameter, span, isOwnScale, more }) {
  const query = new URLSearchParams();
  if (parameter && tab === "lasting") query.set("quantity", parameter);
  if (parameter && tab === "parameters") query.set("parameter", parameter);
  if (!span.isLive) {
    query.set("from", span.from_s.toFixed(DECIMALS));
    query.set("to", span.to_s.toFixed(DECIMALS));
  } else if (span.length_s !== span.usual_s) {
    query.set("span", span.length_s);
  }
  if (isOwnScale) query.set("scale", "own");
  for (const [name, value] of Object.entries(more ?? {})) if (value) query.set(name, value);
  return address(structure, tab === "now" ? null : tab, query);
}

function address(structure, tab, query) {
  const text = query.toString();
  return `#/structure/${encodeURIComponent(structure)}${tab ? `/${tab}` : ""}${text ? `?${text}` : ""}`;
}

/**
 * Returns the time span in an address: `{ from_s, to_s }`, `{ length_s }`, or null. `around_s` is
 * shown on each side of a moment.
 */
export function spanOf(parameters, around_s) {
  const number = (name) => (parameters.has(name) ? Number(parameters.get(name)) : NaN);
  const [at, from_s, to_s, length_s] = ["at", "from", "to", "span"].map(number);
  if (at > 0) return { from_s: at - around_s, to_s: at + around_s };
  if (Number.isFinite(from_s) && Number.isFinite(to_s) && to_s > from_s) return { from_s, to_s };
  return length_s > 0 && Number.isFinite(length_s) ? { length_s } : null;
}
