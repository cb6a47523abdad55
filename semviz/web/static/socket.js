/* The page's websocket: JSON both ways, reconnecting, keeping the session. */

const LONGEST_WAIT_MS = 5000;

/** Connects to `socket` beside the page. `onmessage(object)` gets what the server sends, but for the session's id,
 * which goes to `onsession(id, isNew)`; `onstate(connected)` tells when the line breaks and heals.
 * `send(object)` returns false, and sends nothing, while there is no line. */
export class Socket {
  constructor({ onmessage, onsession, onstate }) {
    this._handlers = { onmessage, onsession, onstate };
    this._session = "";
    this._wait = 200;
    this._open();
  }

  send(message) {
    if (this._socket.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify(message));
    return true;
  }

  _open() {
    const query = this._session ? `?session=${encodeURIComponent(this._session)}` : "";
    const address = new URL(`socket${query}`, location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    this._socket = new WebSocket(address);
    this._socket.addEventListener("message", (event) => this._receive(JSON.parse(event.data)));
    this._socket.addEventListener("close", () => {
      this._handlers.onstate(false);
      setTimeout(() => this._open(), this._wait);
      this._wait = Math.min(LONGEST_WAIT_MS, this._wait * 2);
    });
  }

  _receive(message) {
    if (message.type !== "session") {
      this._handlers.onmessage(message);
      return;
    }
    const isNew = message.id !== this._session;
    this._session = message.id;
    this._wait = 200;
    this._handlers.onstate(true);
    this._handlers.onsession(message.id, isNew);
  }
}
