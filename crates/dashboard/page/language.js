// The language of the page. All words are in the tables; the sentences of the services are in English.

import { english } from "./english.js";
import { german } from "./german.js";

/** Key of the chosen language in local storage. */
const LANGUAGE_KEY = "spandrel-language";
const TABLES = { en: english, de: german };
/** Language of what the services write: reasons, events and states of modes. */
export const SERVICES = "en";

/** Language of the page: the chosen one, or else the first language of the browser that has a table. */
export const language = [localStorage.getItem(LANGUAGE_KEY), ...navigator.languages.map((tag) => tag.slice(0, 2)), "en"].find((one) => one in TABLES);

const table = TABLES[language];

/** Returns the words of a key. `{0}` in them is replaced by the first value, `{1}` by the second. */
export function t(key, ...values) {
  return table[key].replaceAll(/\{(\d)\}/g, (_, index) => String(values[index] ?? ""));
}

/** Returns the word for a state or a quantity of the services, such as `ground-acceleration`. */
export function wordOf(token) {
  return table[`word-${token}`] ?? token.replaceAll("-", " ");
}

/**
 * Returns a number or a date (2026-03-01, 2026-03) as the language of the page writes it. People read the
 * result. Files, addresses and the sentences of the services keep the decimal point and ISO 8601.
 */
export function inLanguage(text) {
  if (language !== "de") return text;
  return /^\d{4}-\d\d/.test(text) ? text.split("-").toReversed().join(".") : text.replace(".", ",");
}

/** Formats a number with a fixed number of decimals, for people. */
export function fixed(value, digits) {
  return inLanguage(value.toFixed(digits));
}

/** Loads the page again in the other language. The address keeps what is shown. */
export function switchLanguage() {
  localStorage.setItem(LANGUAGE_KEY, language === "en" ? "de" : "en");
  location.reload();
}
