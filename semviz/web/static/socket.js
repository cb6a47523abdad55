// @ts-check
/* The page's connection to its server: typed JSON messages, request ids, reconnection, one session. */

const PROTOCOL = 3;
const FIRST_WAIT_MS = 200;
const LONGEST_WAIT_MS = 5000;
const RELOADED = "semviz-reloaded";

/** @typedef {import("/static/protocol").ErrorEvent} ErrorEvent */
/** @typedef {import("/static/protocol").HelloEvent} HelloEvent */

/** A request that the server refused, or that was unanswered when the connection broke (`offline`). */
export class Refusal extends Error {
  /** @param {{code: ErrorEvent["code"] | "offline", text: string, retry: boolean}} event */
  constructor({ code, text, retry }) {
    super(text);
    this.code = code;
    this.retry = retry;
  }
}

/** Connects to `socket` beside the page, and reconnects whenever the connection breaks.
 *
 * `Requests` and `Events` are a tool's messages by type, for example `annotator.Requests` and
 * `annotator.Events` of protocol.d.ts.
 *
 * @template {{[type: string]: any}} Requests
 * @template {{[type: string]: any}} Events
 */
export class PageSocket {
  constructor() {
    this.session = ""; // the server's id of this page; it changes when the server restarts
    /** @type {Map<string, ((event: any) => void)[]>} */
    this._handlers = new Map();
    /** @type {((connected: boolean) => void)[]} */
    this._connectionHandlers = [];
    /** @type {Map<string, {resolve: (event: any) => void, reject: (refusal: Refusal) => void}>} */
    this._awaited = new Map();
    this._count = 0;
    this._wait = FIRST_WAIT_MS;
    this._socket = this._connect();
  }

  /** Calls `handler` for every event of a type; several handlers are called in order of registration.
   *
   * @template {keyof Events & string} Type
   * @param {Type} type
   * @param {(event: Events[Type]) => void} handler
   */
  on(type, handler) {
    this._handlers.set(type, [...(this._handlers.get(type) ?? []), handler]);
  }

  /** Calls `handler` when the connection breaks (false) and when it is restored (true), before `hello`.
   *
   * @param {(connected: boolean) => void} handler
   */
  onConnection(handler) {
    this._connectionHandlers.push(handler);
  }

  /** Sends a request; its answer goes to the handlers. Returns false, and sends nothing, without a
   * connection. An outbox passes its own `id`, so that it recognizes the answer.
   *
   * @template {keyof Requests & string} Type
   * @param {Type} type
   * @param {Omit<Requests[Type], "type" | "id">} [fields]
   * @param {string} [id]
   */
  send(type, fields, id = this._newId()) {
    if (this._socket.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify({ type, id, ...fields }));
    return true;
  }

  /** Sends a request and resolves with the event that names it in `reply_to`, after that event's
   * handlers. Rejects with a `Refusal`, which is not passed to `error` handlers.
   *
   * @template {keyof Requests & string} Type
   * @param {Type} type
   * @param {Omit<Requests[Type], "type" | "id">} [fields]
   * @returns {Promise<any>}
   */
  request(type, fields) {
    const id = this._newId();
    return new Promise((resolve, reject) => {
      if (this.send(type, fields, id)) this._awaited.set(id, { resolve, reject });
      else reject(offline());
    });
  }

  _newId() {
    this._count += 1;
    return String(this._count);
  }

  _connect() {
    const query = this.session ? `?session=${encodeURIComponent(this.session)}` : "";
    const address = new URL(`socket${query}`, location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(address);
    socket.addEventListener("message", ({ data }) => this._receive(JSON.parse(data)));
    socket.addEventListener("close", () => this._broken());
    return socket;
  }

  _broken() {
    for (const { reject } of this._awaited.values()) reject(offline());
    this._awaited.clear();
    for (const handler of this._connectionHandlers) handler(false);
    setTimeout(() => { this._socket = this._connect(); }, this._wait);
    this._wait = Math.min(LONGEST_WAIT_MS, this._wait * 2);
  }

  /** @param {{type: string, reply_to: string | null}} event */
  _receive(event) {
    if (event.type === "hello") {
      const hello = /** @type {HelloEvent} */ (event);
      if (hello.protocol !== PROTOCOL) {
        this._reload(hello.protocol);
        return;
      }
      this._restored(hello);
    }
    const awaited = this._awaited.get(event.reply_to ?? "");
    this._awaited.delete(event.reply_to ?? "");
    if (awaited && event.type === "error") {
      awaited.reject(new Refusal(/** @type {ErrorEvent} */ (event)));
      return;
    }
    for (const handler of this._handlers.get(event.type) ?? []) handler(event);
    awaited?.resolve(event);
  }

  /** @param {HelloEvent} hello */
  _restored({ session }) {
    sessionStorage.removeItem(RELOADED);
    this.session = session;
    this._wait = FIRST_WAIT_MS;
    for (const handler of this._connectionHandlers) handler(true);
  }

  /** Reloads a page of another version than the server. Only once: a cache may return the old page.
   *
   * @param {number} protocol
   */
  _reload(protocol) {
    if (sessionStorage.getItem(RELOADED) === String(protocol)) {
      const text = "This page is older than its server; reload it without the cache (Ctrl Shift R).";
      for (const handler of this._handlers.get("error") ?? []) {
        handler({ type: "error", reply_to: null, code: "invalid", text, retry: false });
      }
      return;
    }
    sessionStorage.setItem(RELOADED, String(protocol));
    location.reload();
  }
}

function offline() {
  return new Refusal({ code: "offline", text: "Offline: the server does not answer.", retry: true });
}
