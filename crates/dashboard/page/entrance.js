// Requests a token if the server requires one. The page sends the token once and does not store it.

import { h, setText } from "./dom.js";
import { t } from "./language.js";

const ADDRESS = "/api/session";
/** Minimum interval between checks whether the session has ended (ms). */
const ASKED_EVERY_MS = 5000;

/** Returns as soon as this browser is admitted. Shows a form until then. */
export async function letIn(place) {
  if (!(await isRefused())) return;
  await new Promise((resolve) => place.replaceChildren(form(resolve)));
}

/** Reloads the page, which then requests a token, when the session has ended. */
export function watchSession(connection) {
  let asked = 0;
  connection.on("state", async () => {
    if (connection.isOpen || performance.now() - asked < ASKED_EVERY_MS) return;
    asked = performance.now();
    if (await isRefused()) location.reload();
  });
}

/** Returns whether the server replies but requires a token. */
async function isRefused() {
  try {
    return (await fetch(ADDRESS)).status === 401;
  } catch {
    return false;
  }
}

function form(done) {
  const told = h("p", { class: "empty", role: "alert" }, "");
  const token = h("input", { type: "password", name: "token", autocomplete: "current-password", required: true, id: "token" });
  const submit = async (event) => {
    event.preventDefault();
    const body = JSON.stringify({ token: token.value });
    try {
      const response = await fetch(ADDRESS, { method: "POST", headers: { "content-type": "application/json" }, body });
      if (response.ok) return done();
      const { error, allowed } = await response.json();
      setText(told, `${error}; ${allowed}`);
    } catch {
      setText(told, t("no-reply-from-spandrel"));
    }
    token.value = "";
    token.focus();
  };
  return h("form", { class: "empty", id: "entrance", onsubmit: submit }, h("label", { for: "token" }, t("token")), token, " ", h("button", { type: "submit" }, t("enter")), told);
}
