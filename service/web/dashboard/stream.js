// The service as the page knows it: one snapshot first, then news; and whether it is still there.

const HEARTBEAT_MS = 10_000; // the longest silence of a service that is there
const QUICK_MS = 4_000; // with an RTC something changes twice a second
const HIDDEN_MS = 60_000; // a page nobody sees gives its connection back after this

export class Service extends EventTarget {
  state = null;
  reconstructors = [];
  connected = false;
  lostSince = Date.now();
  locked = false; // until somebody logs in
  forbidden = ""; // why nothing can be ordered from here
  #heard = 0; // performance.now() of the last message
  #source = null;
  #hiding = 0;
  #reading = 0;

  constructor() {
    super();
    document.addEventListener("visibilitychange", () => this.#seen());
    // a page that is left may be kept for going back, and with it one of the six connections of a browser
    window.addEventListener("pagehide", () => this.#rest());
    window.addEventListener("pageshow", (event) => event.persisted && this.start());
    setInterval(() => this.#watch(), 500);
  }

  // The service's clock, milliseconds; the page's own until it is known.
  get now() {
    if (!this.state) return Date.now();
    return this.state.now_ns / 1e6 + (performance.now() - this.#heard);
  }

  // Whether what is shown is of this moment.
  get fresh() {
    return this.connected && performance.now() - this.#heard < this.#patience;
  }

  get age_s() {
    return (performance.now() - this.#heard) / 1000;
  }

  start() {
    this.#source?.close();
    const source = new EventSource("v1/stream");
    this.#source = source;
    source.addEventListener("state", (event) => this.#take(JSON.parse(event.data)));
    source.addEventListener("log", (event) => this.#line(JSON.parse(event.data)));
    source.addEventListener("reset", () => this.#readLog());
    source.onerror = () => {
      this.#lose();
      // a browser gives up for good on an answer that is no stream, such as 401 or 503
      if (source.readyState !== EventSource.CLOSED) return;
      this.#tell("closed");
      setTimeout(() => source === this.#source && !this.locked && this.start(), 2000);
    };
  }

  async get(path, cache = "no-store") {
    return (await this.seen(path, cache)).body;
  }

  // What is there, with the ETag of just this: an order decided on it is refused once it has changed.
  async seen(path, cache = "no-store") {
    const answer = await fetch(path, { cache });
    if (!answer.ok) throw new Error(`${path}: ${answer.status}`);
    return { body: await answer.json(), tag: answer.headers.get("ETag") };
  }

  // Give an order; what is answered is text, and whether it was refused. One key is one order, however often it is sent.
  // With the tag of what it was decided on it is carried out only while that is so.
  async order(method, path, body, key, tag = null) {
    let answer;
    try {
      answer = await fetch(path, {
        method,
        headers: {
          "Content-Type": "application/json",
          "Idempotency-Key": key,
          ...(tag && { "If-Match": tag, Prefer: "handling=strict" }),
        },
        body: body && JSON.stringify(body),
      });
    } catch {
      return { refused: true, lost: true, text: "the service does not answer; it is not known whether the order was carried out" };
    }
    const told = await answer.json().catch(() => ({}));
    return { refused: !answer.ok, stale: answer.status === 412, told, text: told.detail ?? told.text ?? `${answer.status} ${answer.statusText}` };
  }

  get #patience() {
    return this.state?.rtc ? QUICK_MS : HEARTBEAT_MS + QUICK_MS;
  }

  #take(state) {
    const before = this.state;
    this.state = state;
    this.#heard = performance.now();
    if (!this.connected) {
      this.connected = true;
      this.#tell("found");
    }
    if (this.#shelf(before) !== this.#shelf(state)) this.#readSoon();
    this.#tell("state", before);
  }

  // What a change of the reconstructors is seen by.
  #shelf(state) {
    return state && JSON.stringify([state.in_use, state.waiting_for.map((w) => w.text), state.margin?.reason]);
  }

  // Several changes of a moment are read once.
  #readSoon() {
    clearTimeout(this.#reading);
    this.#reading = setTimeout(() => this.#readReconstructors(), 50);
  }

  async #readReconstructors() {
    try {
      this.reconstructors = (await this.get("v1/reconstructors")).reconstructors;
      this.#tell("reconstructors");
    } catch {
      setTimeout(() => this.connected && this.#readSoon(), 1000);
    }
  }

  async #readLog() {
    try {
      const { log } = await this.get("v1/events?limit=500");
      this.#tell("reset");
      this.#tell("log", log);
      this.#readSoon();
    } catch {
      this.#lose();
    }
  }

  #line(entry) {
    this.#tell("log", [entry]);
    if (entry.name.startsWith("reconstructor.")) this.#readSoon();
  }

  #watch() {
    if (this.connected && performance.now() - this.#heard > this.#patience) {
      this.#lose();
      this.start();
    }
    this.#tell("tick");
  }

  #lose() {
    if (this.connected) {
      this.connected = false;
      this.lostSince = Date.now();
    }
    this.#tell("lost");
  }

  #seen() {
    clearTimeout(this.#hiding);
    if (document.hidden) {
      this.#hiding = setTimeout(() => this.#rest(), HIDDEN_MS);
    } else if (!this.#source) {
      this.start();
    }
  }

  #rest() {
    this.#source?.close();
    this.#source = null;
    this.connected = false;
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
