// The connection to the page's server: what stations say comes by a WebSocket, requests go by POST.

const FIRST_RETRY_MS = 300;
const LONGEST_RETRY_MS = 3000;

/** Keeps a WebSocket open and tells `on` what comes: hello, summary, stretch, skipped, samples,
 * connected. What was shown is asked for again after a break, from where it ended. */
export class Link {
  constructor(on) {
    this.on = on;
    this.shown = new Map();
    this.retry_ms = FIRST_RETRY_MS;
    this.open();
    // A laptop that wakes up need not wait for the timer.
    addEventListener("online", () => this.hurry());
    document.addEventListener("visibilitychange", () => document.hidden || this.hurry());
  }

  open() {
    clearTimeout(this.timer);
    this.socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/feed`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.retry_ms = FIRST_RETRY_MS;
      this.on.connected(true);
      for (const [stream, resume] of this.shown) this.ask(stream, resume());
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return this.on.samples(decode(data));
      const told = JSON.parse(data);
      this.on[told.kind](told);
    };
    this.socket.onclose = () => {
      this.on.connected(false);
      this.timer = setTimeout(() => this.open(), this.retry_ms);
      this.retry_ms = Math.min(this.retry_ms * 1.6, LONGEST_RETRY_MS);
    };
  }

  hurry() {
    if (this.socket.readyState === WebSocket.CLOSED) this.open();
  }

  /** Show a marker as stream number `stream`; `resume()` returns what is shown and how far it is. */
  show(stream, resume) {
    this.shown.set(stream, resume);
    if (this.socket.readyState === WebSocket.OPEN) this.ask(stream, resume());
  }

  hide(stream) {
    this.shown.delete(stream);
    if (this.socket.readyState === WebSocket.OPEN) this.ask(stream, null);
  }

  ask(stream, show) {
    this.socket.send(JSON.stringify({ stream, show }));
  }
}

/** Columns of samples; the layout is that of history.message. */
function decode(buffer) {
  const [stream, count] = new Uint32Array(buffer, 0, 2);
  let at = 8;
  const column = (type) => {
    const values = new type(buffer, at, count);
    at += values.byteLength;
    return values;
  };
  return {
    stream,
    count,
    t_s: column(Float64Array),
    seq: column(Float64Array),
    x: column(Float32Array),
    y: column(Float32Array),
    sigma_x: column(Float32Array),
    sigma_y: column(Float32Array),
    rotation: column(Float32Array),
    status: column(Uint32Array),
  };
}

let token = sessionStorage.getItem("token") ?? "";

export const hasToken = () => token !== "";

export function setToken(text) {
  token = text;
  sessionStorage.setItem("token", text);
}

/** Ask a station; returns its answer, also a refused one, with `done` false and a `text`. */
export async function ask(station, verb, fields = {}) {
  const headers = { "Content-Type": "application/json" };
  if (token) headers.Authorization = `Bearer ${token}`;
  try {
    const response = await fetch(`/ask/${encodeURIComponent(station)}/${verb}`, {
      method: "POST", headers, body: JSON.stringify(fields),
    });
    return await response.json();
  } catch {
    return { done: false, code: "no-server", text: "The page's server does not answer; is vdms-rt view still running?" };
  }
}
