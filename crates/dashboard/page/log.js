// The changes of alerts and the events of a period. A message of the server contains only the newest
// ones; the log of a period also contains those that only the history stores.

import { t } from "./language.js";
import { time } from "./words.js";

/** Largest number of messages to read from the history. The server allows 4000. */
const MOST = 4000;

/** The log without a reply. */
export const NO_REPLY = { history: "no-reply", isRead: false, cut_at_s: null, changes: [], events: [] };

/**
 * Fetches the log of a structure, of all times without a period. `isRead` states whether the history
 * has replied. `cut_at_s` is the time before which the period may contain more, or null.
 */
export async function fetchLog(structure, { from_s, to_s } = {}) {
  const period = from_s === undefined ? {} : { from: from_s, to: to_s };
  const response = await fetch(`/api/structures/${encodeURIComponent(structure)}/log?${new URLSearchParams({ ...period, most: MOST })}`);
  if (!response.ok) return NO_REPLY;
  const log = await response.json();
  return { ...log, isRead: log.history === "read" };
}

export function keyOfChange({ kind, parameter, state, changed_ns: at }) {
  return `${kind}/${parameter}/${state}/${at}`;
}

export function keyOfEvent({ time_ns, kind, subject, what }) {
  return `${time_ns}/${kind}/${subject}/${what}`;
}

/** Returns the items of two lists, each item once. Those of the first list count. */
export function merged(first, second, key) {
  return [...new Map([...second, ...first].map((item) => [key(item), item])).values()];
}

/** Returns why a log may lack events, or an empty text. */
export function whatLogLacks({ history, cut_at_s: cut }) {
  if (history === "absent") return t("no-history-runs");
  if (history === "no-reply") return t("history-has-not-replied");
  return cut === null ? "" : t("more-events-before", time(cut));
}
