// The export of the samples of a time range as a file.

import { h, setText } from "./dom.js";
import { t } from "./language.js";

/** Formats of the file: the name for people, and that of the request. */
const FORMATS = [
  ["MCAP", "mcap"],
  ["miniSEED", "mseed"],
  ["CSV", "csv"],
];

/**
 * Creates the buttons that save the samples of a structure. `range()` returns the range (s since 1970)
 * when one is pressed, and `about` names it for a screen reader. The reason of a failure is shown beside
 * the buttons.
 */
export function samplesExport(structure, range, about) {
  const told = h("span", { class: "told", role: "status" });
  const save = async (format) => {
    const [from, to] = range();
    setText(told, t("samples-are-collected"));
    buttons.forEach((button) => (button.disabled = true));
    setText(told, await saved(`/api/structures/${encodeURIComponent(structure)}/samples?${new URLSearchParams({ from: from.toFixed(6), to: to.toFixed(6), format })}`));
    buttons.forEach((button) => (button.disabled = false));
  };
  const buttons = FORMATS.map(([name, format]) => h("button", { type: "button", class: "small", onclick: () => save(format), "aria-label": t("download-samples-as", about, name) }, name));
  return h("span", { class: "samples-export" }, buttons, told);
}

/** Saves a file, and returns what prevents it, or nothing. */
export async function saved(address) {
  try {
    const response = await fetch(address);
    if (!response.ok) {
      const { error, allowed } = await response.json();
      return t("samples-not-saved", error, allowed);
    }
    const name = response.headers.get("content-disposition").match(/filename="(.*)"/)[1];
    const file = URL.createObjectURL(await response.blob());
    h("a", { href: file, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(file), 60000);
    return "";
  } catch {
    return t("cannot-reach-spandrel");
  }
}
