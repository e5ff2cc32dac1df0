// The form with which people note what they know about a judged structure.

import { NAME_KEY } from "./alerts.js";
import { h, setText } from "./dom.js";
import { t, wordOf } from "./language.js";
import { asTimeField, timeOfField, zone } from "./time.js";

/** Subjects of a note, as in the message. */
const KINDS = ["inspection", "repair", "maintenance", "weather", "traffic", "other"];
/** Effects of a note on the judgement, as in the message. */
const EFFECTS = [
  ["none", t("none")],
  ["seen", t("lasting-change-seen")],
  ["new-reference", t("reference-starts-anew")],
];

/** Dialog that sends a note, and waits until the service judge has kept it. */
export class NoteDialog {
  /** `done(text)` is called with the outcome once a note has been sent. */
  constructor(structure, quantities, done) {
    Object.assign(this, { structure, done });
    const option = ([value, text]) => h("option", { value }, text);
    const field = (name, text, input) => {
      input.id = `note-${name}`;
      return [h("label", { for: input.id }, text), input];
    };
    const now = zone(Date.now() / 1000);
    this.kind = h("select", {}, KINDS.map((kind) => option([kind, wordOf(kind)])));
    this.quantity = h("select", {}, [["", t("all-quantities")], ...quantities.map((quantity) => [quantity, quantity])].map(option));
    this.effect = h("select", { onchange: () => this.#explain() }, EFFECTS.map(option));
    this.text = h("textarea", { required: true, rows: 3, maxlength: 1000 });
    this.who = h("input", { required: true, maxlength: 100, autocomplete: "name" });
    this.from = asTimeField(h("input"));
    this.to = asTimeField(h("input"));
    this.told = h("p", { class: "told", role: "status" });
    this.send = h("button", { type: "submit", class: "main" }, t("save-the-note"));
    this.element = h(
      "dialog",
      { id: "note-dialog", "aria-labelledby": "note-title" },
      h(
        "form",
        { method: "dialog", onsubmit: (event) => this.#submit(event) },
        h("h2", { id: "note-title" }, t("add-a-note-to", structure)),
        field("subject", t("subject"), this.kind),
        field("quantity", t("quantity"), this.quantity),
        field("effect", t("effect"), this.effect),
        field("text", t("note-text"), this.text),
        field("who", t("your-name"), this.who),
        field("from", t("beginning-empty-for-now", now), this.from),
        field("to", t("end-empty-for-a-moment", now), this.to),
        this.told,
        h("div", { class: "actions" }, this.send, h("button", { type: "button", onclick: () => this.element.close() }, t("cancel"))),
      ),
    );
  }

  /** Opens the form for a note about one quantity, or about all of them. */
  open(quantity) {
    for (const input of [this.text, this.from, this.to]) input.value = "";
    this.kind.value = KINDS[0];
    this.effect.value = EFFECTS[0][0];
    this.quantity.value = quantity ?? "";
    this.who.value = localStorage.getItem(NAME_KEY) ?? "";
    this.send.disabled = false;
    this.#explain();
    this.element.showModal();
    this.kind.focus();
  }

  #explain() {
    setText(this.told, `${this.effect.value === "new-reference" ? `${t("starting-anew-clears-the-change")} ` : ""}${t("notes-cannot-be-deleted")}`);
  }

  async #submit(event) {
    event.preventDefault();
    const now = Date.now() / 1000;
    const [text, who] = [this.text.value.trim(), this.who.value.trim()];
    const [from, to] = [this.from, this.to].map(({ value }) => (value ? timeOfField(value) : null));
    if (!text) return this.#refuse(t("please-enter-a-note"), this.text);
    if (!who) return this.#refuse(t("please-enter-your-name"), this.who);
    if (Number.isNaN(from)) return this.#refuse(t("time-must-have-the-format", t("format-of-a-time")), this.from);
    if (Number.isNaN(to)) return this.#refuse(t("time-must-have-the-format", t("format-of-a-time")), this.to);
    if (from !== null && from > now) return this.#refuse(t("beginning-in-the-future"), this.from);
    if (to !== null && to < (from ?? now)) return this.#refuse(t("end-not-before-beginning"), this.to);
    localStorage.setItem(NAME_KEY, who);
    this.send.disabled = true;
    setText(this.told, t("sending"));
    const iso = (seconds) => (seconds === null ? null : new Date(1000 * seconds).toISOString());
    const note = { kind: this.kind.value, quantity: this.quantity.value || null, effect: this.effect.value, text, who, from: iso(from), to: iso(to) };
    try {
      const response = await fetch(`/api/structures/${encodeURIComponent(this.structure)}/annotations`, { method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(note) });
      const { error, allowed, kept } = await response.json();
      if (!response.ok) return this.#refuse(`${error}; ${allowed}`, this.send);
      this.done(kept ? t("the-note-is-saved") : "");
      // The text would be lost if judge has refused the note.
      if (!kept) return this.#refuse(t("the-note-is-not-confirmed"), this.send);
      this.element.close();
    } catch {
      this.#refuse(t("cannot-reach-spandrel-the-note-was-not"), this.send);
    }
  }

  /** Says what is wrong, and moves the focus there. */
  #refuse(text, input) {
    this.send.disabled = false;
    setText(this.told, `▲ ${text}`);
    input.focus();
  }
}
