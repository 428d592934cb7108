// The registration now and over the last time: what is read, when, and how much of it is kept.

import { Charts, markOf } from "./charts.js";
import { DASH, ago, clock, milliseconds, put, span } from "./words.js";

const RANGES = { 1: 600, 2: 3600, 3: 43_200 }; // seconds: ten minutes, an hour, a night
const POINTS = { 1: 600, 2: 1200, 3: 2000 };
const MOST = 4000; // then the range is read anew, thinned by the service
const EVERY_MS = 5000; // between two looks at what has been measured since
const SAMPLED_MS = 10_000; // between two looks at what was sampled beside measurements
const LATE_MS = 5000; // telemetry takes less than this to be understood: more is another clock

export class Registration {
  #service;
  #entries = []; // of the service's history, oldest first
  #marks = [];
  #samples = []; // of the trends, oldest first
  #interval = 0;
  #sampled = 0;
  #mirror = null;
  #charts;
  #range = 1;
  #reading = false;
  #asked = 0;
  #drawn = 0;

  constructor(service, root) {
    this.#service = service;
    this.root = root;
    this.#charts = new Charts(root.querySelector(".charts"));
    for (const button of root.querySelectorAll("[data-range]"))
      button.addEventListener("click", () => this.choose(Number(button.dataset.range)));
    service.addEventListener("state", () => this.#onState());
    service.addEventListener("tick", () => this.#onTick());
    service.addEventListener("log", (event) => this.#mark(event.detail));
    service.addEventListener("reset", () => this.#begin());
    document.addEventListener("scheme", () => this.#draw());
  }

  choose(range) {
    this.#range = range;
    for (const button of this.root.querySelectorAll("[data-range]"))
      button.setAttribute("aria-pressed", String(Number(button.dataset.range) === range));
    this.#begin();
  }

  set mirror(mirror) {
    this.#mirror = mirror;
    this.#draw();
  }

  // Read the range anew: at the start, on another range, after a gap.
  async #begin() {
    this.#entries = [];
    this.#samples = [];
    await Promise.all([this.#read(), this.#readMarks(), this.#readSamples()]);
  }

  // The log remembers the last of them only, and this run alone.
  async #readMarks() {
    try {
      const { marks } = await this.#service.get(`v1/marks?since=${new Date(this.#since).toISOString()}&limit=2000`);
      this.#add(marks.map(({ t_ns_utc: t, kind }) => ({ t: t / 1e9, kind })));
    } catch {
      // those of the log are there
    }
  }

  get #since() {
    return Math.max(0, this.#service.now - RANGES[this.#range] * 1000);
  }

  // What is read again comes from where the last of it was.
  async #readSamples() {
    this.#sampled = performance.now();
    const range = this.#range;
    const last = this.#samples.at(-1)?.t_ns_utc;
    const since = last ? new Date(last / 1e6 + 1) : new Date(this.#since);
    try {
      const { samples, interval_s: interval } = await this.#service.get(`v1/trends?since=${since.toISOString()}&points=${POINTS[range]}`);
      if (range !== this.#range) return;
      this.#interval = Math.max(interval, last ? this.#interval : 0);
      const oldest = this.#since - 60_000;
      this.#samples = [...this.#samples, ...samples.filter((s) => s.t_ns_utc > (this.#samples.at(-1)?.t_ns_utc ?? 0))].filter((s) => s.t_ns_utc / 1e6 > oldest);
    } catch {
      // as of the measurements
    }
  }

  // By how much the RTC's clock, which dates telemetry, is behind the service's, milliseconds.
  get #behind() {
    const { state } = this.#service;
    const known = state?.registration;
    const ms = known ? (state.now_ns - known.t_ns_utc) / 1e6 - known.age_s * 1000 : 0;
    return Math.abs(ms) > LATE_MS ? ms : 0;
  }

  async #read() {
    if (this.#reading) return;
    this.#reading = true;
    this.#asked = performance.now();
    const range = this.#range;
    const since = Math.max(0, this.#since - this.#behind);
    const last = this.#entries.at(-1)?.t_ns_utc;
    const query = last ? `after=${last}&limit=2000` : `since=${new Date(since).toISOString()}&points=${POINTS[range]}`;
    try {
      const { entries } = await this.#service.get(`v1/alpha/history?${query}`);
      if (range === this.#range) {
        const newest = this.#entries.at(-1)?.t_ns_utc ?? 0;
        this.#entries.push(...entries.filter((e) => e.t_ns_utc > newest));
        this.#forget(since);
      }
    } catch {
      // the banner tells that the connection is lost; the next state asks again
    } finally {
      this.#reading = false;
      if (range !== this.#range) this.#begin();
    }
    this.#draw();
  }

  #forget(since) {
    const first = this.#entries.findIndex((e) => e.t_ns_utc / 1e6 >= since);
    this.#entries.splice(0, first < 0 ? 0 : first);
    if (this.#entries.length > MOST) this.#entries = [];
  }

  #mark(lines) {
    this.#add(lines.map(markOf).filter(Boolean));
  }

  #add(marks) {
    const known = new Set(this.#marks.map((mark) => `${mark.t} ${mark.kind}`));
    this.#marks.push(...marks.filter((mark) => !known.has(`${mark.t} ${mark.kind}`)));
    this.#marks = this.#marks.sort((a, b) => a.t - b.t).slice(-MOST);
  }

  #onState() {
    const known = this.#service.state.registration;
    this.#charts.tell(known?.alpha, known?.sigma, known?.tracking_sigma);
    const newest = this.#entries.at(-1)?.t_ns_utc ?? 0;
    // the state itself is the last point of every line: what is behind it may come later
    const due = performance.now() - this.#asked > EVERY_MS || !newest;
    if (known && due && known.t_ns_utc > newest + 1000) this.#read();
  }

  #onTick() {
    const { state, now, fresh } = this.#service;
    const known = state?.registration;
    if (fresh && !document.hidden && performance.now() - this.#sampled > SAMPLED_MS) this.#readSamples();
    const old = !fresh || (known && known.validity !== "fresh");
    for (const { value } of this.#charts.rows) value.parentElement.classList.toggle("old", Boolean(old));
    const measured = known && milliseconds(known.t_ns_utc);
    // nobody knows what it is worth by now: only how old it is
    const worth = fresh ? known?.validity : `✕ connection lost ${span(this.#service.age_s)} ago`;
    const why = fresh && known?.validity_reason ? `: ${known.validity_reason}` : "";
    const told = known ? `${worth}, from telemetry of ${ago(measured, now)}${why}${known.sigma_limit ? `; ${known.sigma_limit}` : ""}` : "not measured yet";
    put(this.root.querySelector(".worth"), state ? told : DASH);
    if (performance.now() - this.#drawn > 1000) this.#draw();
  }

  #draw() {
    const { state, now, fresh } = this.#service;
    if (document.hidden || !state) return;
    this.#drawn = performance.now();
    this.#charts.show({
      entries: this.#entries,
      samples: this.#samples,
      interval: this.#interval,
      marks: this.#marks,
      from: now / 1000 - RANGES[this.#range],
      to: now / 1000,
      tolerance: (parameter) => this.#tolerance(parameter),
      ahead: this.#behind / 1000,
      last: fresh && state.rtc ? state.registration : null,
    });
    const first = this.#entries[0];
    const span = first ? `${this.#entries.length} measurements since ${clock(first.t_ns_utc / 1e6)} UTC` : "no measurement in this time";
    put(this.root.querySelector(".span"), span);
  }

  // How far α may go from what the matrix in use was made for.
  #tolerance({ key, scale }) {
    const { state, reconstructors } = this.#service;
    const made = reconstructors.find((r) => r.id === state.in_use)?.alpha;
    if (!made || !this.#mirror) return [null, null];
    const reach = this.#mirror.tolerance[key];
    return [(made[key] - reach) * scale, (made[key] + reach) * scale];
  }
}
