// Starts the page and shows the view in the address: all structures, one structure, the alerts, or
// a report.

import { AlertsPage } from "./alerts.js";
import { Connection } from "./connection.js";
import { h, setText } from "./dom.js";
import { letIn, watchSession } from "./entrance.js";
import { language, switchLanguage, t } from "./language.js";
import { OverviewPage } from "./overview.js";
import { ReportPage } from "./report.js";
import { StructurePage } from "./structure.js";
import { duration, isLocal, showLocal } from "./words.js";

const main = document.getElementById("main");
const connection = new Connection();
let page = null;
let raisedBefore = null;

function route() {
  const [path, query] = location.hash.replace(/^#/, "").split("?");
  const chunks = path.split("/").filter(Boolean).map(decodeURIComponent);
  const parameters = new URLSearchParams(query ?? "");
  if (page?.takes?.(chunks, parameters)) return;
  page?.close?.();
  const [kind, name, tab] = chunks;
  if (kind === "structure" && name) page = new StructurePage(connection, name, tab, parameters);
  else if (kind === "alerts") page = new AlertsPage(connection, parameters);
  else if (kind === "report") page = new ReportPage(connection, parameters);
  else if (chunks.length === 0) page = new OverviewPage(connection, parameters);
  else page = notThere();
  main.replaceChildren(page.element);
  mark("nav-structures", chunks.length === 0 || kind === "structure");
  mark("nav-alerts", kind === "alerts");
  mark("nav-report", kind === "report");
  scrollTo(0, 0);
}

function notThere() {
  connection.listen(null);
  return { element: h("p", { class: "empty" }, t("page-not-found"), h("a", { href: "#/" }, t("link-all-structures"))) };
}

function mark(id, isHere) {
  const link = document.getElementById(id);
  if (isHere) link.setAttribute("aria-current", "page");
  else link.removeAttribute("aria-current");
}

/** Shows whether the page is connected to the server, and the age of its data. */
function showState() {
  const link = document.getElementById("link");
  const lost = document.getElementById("lost");
  const silence = connection.silence_s;
  const isOpen = connection.isOpen;
  link.dataset.state = isOpen ? "open" : "lost";
  setText(link.querySelector(".mark"), isOpen ? "●" : "✕");
  if (isOpen) setText(document.getElementById("link-text"), t("connected"));
  else setText(document.getElementById("link-text"), silence === Infinity ? t("connecting") : t("lost-ago", duration(silence)));
  const isLost = !isOpen && silence !== Infinity;
  lost.hidden = !isLost;
  document.body.classList.toggle("is-lost", isLost);
  if (isLost) setText(lost, t("no-connection-to-spandrel-the-data-shown", duration(silence)));
}

/** Shows raised alerts in the title, and announces new ones to screen readers. */
function showAlerts({ structures }) {
  const raised = structures.reduce((sum, structure) => sum + structure.raised, 0);
  const count = document.getElementById("alert-count");
  count.hidden = raised === 0;
  setText(count, `▲ ${raised}`);
  count.setAttribute("aria-label", t("raised-alerts", raised));
  const title = page?.title ?? "Spandrel";
  document.title = raised > 0 && !page?.title ? `▲ ${raised} – ${title}` : title;
  if (raisedBefore !== null && raised > raisedBefore) {
    const first = structures.find((structure) => structure.raised > 0);
    document.getElementById("announce").replaceChildren(t("announce-alarm", first.name), h("span", { lang: "en" }, first.sentence));
  }
  raisedBefore = raised;
}

/** Shows which zone the times have. */
function showZone() {
  const button = document.getElementById("zone");
  button.setAttribute("aria-pressed", String(isLocal()));
  setText(document.getElementById("zone-text"), isLocal() ? t("local") : "UTC");
}

/** Builds the page again, with all times in the other zone. The address keeps what is shown. */
function switchZone() {
  showLocal(!isLocal());
  showZone();
  page?.close?.();
  page = null;
  route();
}

document.documentElement.lang = language;
document.querySelectorAll("[data-words]").forEach((element) => setText(element, t(element.dataset.words)));
document.querySelector("nav").setAttribute("aria-label", t("pages"));
const other = document.getElementById("language");
other.setAttribute("aria-label", t("switch-language"));
other.addEventListener("click", switchLanguage);
showZone();
document.getElementById("zone").addEventListener("click", switchZone);
connection.on("state", showState);
connection.on("overview", showAlerts);
document.getElementById("skip").addEventListener("click", () => main.focus());
await letIn(main);
watchSession(connection);
addEventListener("hashchange", route);
route();
