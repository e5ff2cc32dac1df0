// The WebSocket connection. It passes messages to its listeners, reconnects, and records when the
// last message arrived.

/** Pauses between attempts to connect (s). They grow, but stay short for a waiting user. */
const PAUSES_S = [0.5, 1, 2, 4, 8];
/**
 * Silence after which the connection counts as lost (s). The server sends a message twice a second.
 */
const SILENT_AFTER_S = 5;

export class Connection {
  #listeners = { overview: [], structure: [], points: [], state: [], opened: [] };
  #structure = null;
  #wish = { waveforms: false };
  #socket = null;
  #attempts = 0;
  #timer = null;
  #heard = null;
  #opened = false;

  constructor() {
    setInterval(() => this.#watch(), 1000);
    addEventListener("online", () => this.#again(0));
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden && !this.isOpen) this.#again(0);
    });
  }

  /** Adds a listener and returns a function that removes it. */
  on(kind, listener) {
    this.#listeners[kind].push(listener);
    return () => (this.#listeners[kind] = this.#listeners[kind].filter((other) => other !== listener));
  }

  /** Whether a message has arrived recently. */
  get isOpen() {
    return this.#opened && this.silence_s < SILENT_AFTER_S;
  }

  /** Time since the last message (s), infinite before the first. */
  get silence_s() {
    return this.#heard === null ? Infinity : (performance.now() - this.#heard) / 1000;
  }

  /** Connects for the points of a structure, or without points if it is null. */
  listen(structure) {
    if (structure === this.#structure && this.#socket) return;
    this.#structure = structure;
    this.#open();
  }

  /** Requests the waveforms of the structure, or ends the request. */
  want(waveforms) {
    if (waveforms === this.#wish.waveforms) return;
    this.#wish = { waveforms };
    this.#ask();
  }

  /** Sends the request. A new connection repeats it. */
  #ask() {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(this.#wish));
  }

  #open() {
    clearTimeout(this.#timer);
    this.#leave();
    const query = this.#structure ? `?structure=${encodeURIComponent(this.#structure)}` : "";
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/api/live${query}`);
    socket.onopen = () => this.#wish.waveforms && this.#ask();
    socket.onmessage = (event) => {
      this.#heard = performance.now();
      this.#attempts = 0;
      const isFirst = !this.#opened;
      this.#opened = true;
      if (isFirst) {
        this.#tell("opened");
        this.#tell("state");
      }
      const message = JSON.parse(event.data);
      this.#tell(message.type, message);
    };
    socket.onclose = () => this.#again(this.#attempts);
    this.#socket = socket;
    this.#tell("state");
  }

  #leave() {
    if (!this.#socket) return;
    this.#socket.onopen = this.#socket.onmessage = this.#socket.onclose = null;
    this.#socket.close();
    this.#socket = null;
  }

  #again(attempts) {
    this.#leave();
    this.#opened = false;
    this.#attempts = attempts + 1;
    const pause_s = PAUSES_S[Math.min(attempts, PAUSES_S.length - 1)];
    clearTimeout(this.#timer);
    // The random factor prevents all browsers from reconnecting at the same moment.
    this.#timer = setTimeout(() => this.#open(), 1000 * pause_s * (0.75 + Math.random() / 2));
    this.#tell("state");
  }

  #watch() {
    if (this.#opened && this.silence_s > SILENT_AFTER_S) this.#again(0);
    this.#tell("state");
  }

  #tell(kind, message) {
    for (const listener of this.#listeners[kind] ?? []) listener(message);
  }
}
