// Any night: α with its marks, what was in use and what was wrong for how long, who ordered what.

import { behind } from "./axes.js";
import { Charts } from "./charts.js";
import { Compare } from "./compare.js";
import { HISTORY_ORDERS } from "./history_orders.js";
import { Against, Trends } from "./trends.js";
import { DASH, SYMBOLS, clock, day, holds, make, milliseconds, number, put, registrationOf, span, verdict } from "./words.js";

const LINES = 500; // of the audit trail that are read at once
const HOUR_MS = 3_600_000;

export class History {
  #service;
  #orders;
  #nights = []; // newest first
  #from = 0; // of what is shown, milliseconds
  #to = 0;
  #lines = []; // of the audit trail, newest first
  #reading = 0; // number of the newest reading: an older one that comes late is dropped
  #past = null; // what the charts show
  #isWhole = true; // whether a whole night is shown, not a part that somebody chose

  constructor(service, orders, root) {
    this.#service = service;
    this.#orders = orders;
    this.root = root;
    orders.learn(HISTORY_ORDERS);
    const chosen = (from, to) => this.#span(1000 * from, 1000 * to);
    this.charts = new Charts(root.querySelector("#past"), chosen);
    this.trends = new Trends(root.querySelector("#trends .charts"), chosen);
    this.against = new Against(root.querySelector("#against"));
    this.compare = new Compare(service, orders, root.querySelector("#compare"));
    root.querySelector("[name=note]").addEventListener("click", () => orders.open("note", Math.min(this.#to || Infinity, service.now)));
    document.querySelector("#order").addEventListener("close", () => root.hidden || this.look());
    this.night = root.querySelector("[name=night]");
    this.times = ["from", "to"].map((name) => root.querySelector(`[name=${name}]`));
    this.night.addEventListener("change", () => this.#whole());
    this.times.forEach((time) => time.addEventListener("change", () => this.#typed()));
    for (const [name, act] of Object.entries({ earlier: () => this.#turn(1), later: () => this.#turn(-1), whole: () => this.#whole(), more: () => this.#readLines() }))
      root.querySelector(`button[name=${name}]`).addEventListener("click", act);
    root.querySelector("input[type=search]").addEventListener("input", () => this.#showLines());
    document.addEventListener("scheme", () => this.#draw());
  }

  // The page is looked at: nights may have come.
  async look() {
    let nights;
    try {
      ({ nights } = await this.#service.get("v1/nights"));
    } catch {
      put(this.root.querySelector(".read"), "the nights cannot be read now; try again");
      return;
    }
    const chosen = this.night.value;
    this.#nights = nights.reverse();
    this.night.replaceChildren(...this.#nights.map((n) => make("option", { value: n.date, text: n.date })));
    if (!nights.length) put(this.root.querySelector(".read"), "no night has been archived yet");
    else if (!this.#nights.some((n) => n.date === chosen)) this.#whole();
    else {
      this.night.value = chosen;
      if (this.#isWhole) this.#whole(); // up to now, which is later than when it was read
      else this.#read();
    }
  }

  get #chosen() {
    return this.#nights.find((n) => n.date === this.night.value);
  }

  #turn(step) {
    const k = this.night.selectedIndex + step;
    if (k < 0 || k >= this.#nights.length) return;
    this.night.selectedIndex = k;
    this.#whole();
  }

  // From the first to the last that was measured of it, as far as it is told.
  #whole() {
    const night = this.#chosen;
    if (!night) return;
    this.#span(milliseconds(night.since_ns_utc), Math.min(milliseconds(night.until_ns_utc), Math.max(this.#service.now, 1)), true);
  }

  #typed() {
    const [from, to] = this.times.map((time) => this.#moment(time.value));
    if (from && to && from < to) this.#span(from, to);
    else put(this.root.querySelector(".read"), "the start must be before the end, within a night from noon to noon");
  }

  // A time of the clock in the night that is shown, which begins at its noon; 0: none was typed.
  #moment(text) {
    const [h, m, s] = text.split(":").map(Number);
    if (!Number.isFinite(h) || !this.#chosen) return 0;
    const noon = milliseconds(this.#chosen.since_ns_utc);
    const at = Date.parse(`${day(noon)}T00:00:00Z`) + 1000 * (3600 * h + 60 * m + (s || 0));
    return at < noon ? at + 24 * HOUR_MS : at;
  }

  #span(from, to, narrow = false) {
    [this.#from, this.#to, this.#isWhole] = [from, to, narrow];
    this.#read(narrow);
  }

  async #read(narrow = false) {
    const mine = ++this.#reading;
    const time = this.#time;
    put(this.root.querySelector(".read"), "◐ reading");
    let past;
    try {
      const [history, marks, trends] = await Promise.all([`alpha/history?${time}&points=2000`, `marks?${time}&limit=2000`, `trends?${time}&points=2000`]
        .map((what) => this.#service.get(`v1/${what}`, "no-cache")));
      past = { entries: history.entries, marks: marks.marks, samples: trends.samples, interval: trends.interval_s };
    } catch {
      if (mine === this.#reading) put(this.root.querySelector(".read"), "this time cannot be read now; try again");
      return;
    }
    if (mine !== this.#reading) return;
    this.#past = past;
    if (narrow) this.#narrow(past);
    this.times.forEach((input, k) => (input.value = clock([this.#from, this.#to][k])));
    this.#draw();
    this.#lives();
    this.#lines = [];
    await this.#readLines();
  }

  // Of a whole night only that of which something is there, with a little at both ends.
  #narrow({ entries, marks, samples }) {
    const times = [...entries, ...marks, ...samples].map((e) => milliseconds(e.t_ns_utc));
    if (!times.length) return;
    const [first, last] = [Math.min(...times), Math.max(...times)];
    const margin = Math.max((last - first) * 0.01, 1000);
    [this.#from, this.#to] = [Math.max(this.#from, first - margin), Math.min(this.#to, last + margin)];
  }

  get #time() {
    return `since=${new Date(this.#from).toISOString()}&until=${new Date(this.#to).toISOString()}`;
  }

  #draw() {
    if (!this.#past) return;
    const { entries, samples, interval } = this.#past;
    const marks = this.#past.marks.map(({ t_ns_utc: t, kind }) => ({ t: t / 1e9, kind }));
    const time = { marks, from: this.#from / 1000, to: this.#to / 1000 };
    this.charts.show({ entries, samples, interval, ahead: behind(samples), ...time });
    this.trends.show({ samples, interval, ...time });
    this.against.show(samples);
    const [entry, sample] = [entries.at(-1), samples.findLast((s) => s.alpha && s.telemetry_ns_utc)];
    // between measurements 1 sigma grows
    if (sample && sample.telemetry_ns_utc > (entry?.t_ns_utc ?? 0)) this.charts.tell(sample.alpha, sample.sigma);
    else this.charts.tell(entry?.filtered, entry?.filtered_sigma);
    const night = this.#chosen;
    const what = night ? `${night.n_estimates} measurements that night, ${night.n_swaps} swaps, ${night.n_jumps} jumps, ${night.n_alarms} alarms` : "";
    put(this.root.querySelector(".read"), `${day(this.#from)} ${clock(this.#from)} to ${day(this.#to)} ${clock(this.#to)} UTC; ${what}; next to the charts the last values of this time`);
  }

  // --- what lasted

  #lives() {
    const { entries, marks } = this.#past;
    const lines = [...usedOf(entries), ...lastingOf(marks, this.#to), ...notesOf(marks)].sort((a, b) => a.from - b.from);
    const rows = lines.map((line) => {
      const record = this.#service.reconstructors.find((r) => r.id === line.name);
      const bar = make("div", { className: `life ${line.kind}` });
      const [left, right] = [line.from, line.to].map((t) => (100 * (t - this.#from)) / (this.#to - this.#from));
      bar.style.marginLeft = `${left}%`;
      bar.style.width = `${Math.max(right - left, 0.4)}%`;
      const what = record ? `, ${record.n_modes} modes, ${verdict(record.gate)}` : "";
      const title = record ? registrationOf(record.alpha, record.sigma) : line.text;
      return make("tr", {},
        make("th", { scope: "row", text: `${SYMBOLS[line.kind] ? `${SYMBOLS[line.kind]} ` : ""}${line.name}${what}`, title }),
        make("td", { text: clock(line.from) }), make("td", { text: line.open ? DASH : clock(line.to) }),
        make("td", { text: line.kind === "note" ? DASH : span((line.to - line.from) / 1000) }), make("td", { className: "track" }, bar),
        make("td", { className: "acts" }, ...(record ? this.#acts(record) : [])));
    });
    if (!rows.length) rows.push(make("tr", {}, make("td", { colspan: "6", text: "nothing in this time" })));
    this.root.querySelector("#lives tbody").replaceChildren(...rows);
  }

  // What can be done with a reconstructor of that time.
  #acts({ id }) {
    const act = (text, does) => {
      const button = make("button", { type: "button", text, aria_label: `${text} ${id}` });
      button.addEventListener("click", does);
      return button;
    };
    const compare = act("Compare", () => {
      this.compare.choose(id);
      this.root.querySelector("#compare").scrollIntoView();
    });
    return id === this.#service.state?.in_use ? [compare] : [compare, act("Publish again …", () => this.#orders.open("publish", id))];
  }

  // --- who ordered what

  async #readLines() {
    const mine = this.#reading;
    const oldest = this.#lines.at(-1);
    const until = oldest ? new Date(milliseconds(oldest.t_ns_utc) - 0.001).toISOString() : new Date(this.#to).toISOString();
    const more = this.root.querySelector("[name=more]");
    try {
      const { entries } = await this.#service.get(`v1/audit?since=${new Date(this.#from).toISOString()}&until=${until}&limit=${LINES}`);
      if (mine !== this.#reading) return;
      const known = new Set(this.#lines.map((line) => line.id));
      const fresh = entries.filter((entry) => !known.has(entry.id)).reverse();
      this.#lines.push(...fresh);
      more.hidden = entries.length < LINES || !fresh.length;
    } catch {
      more.hidden = false;
    }
    const links = this.root.querySelector("#trail .links");
    links.replaceChildren(...["csv", "jsonl"].map((kind) =>
      make("a", { href: `v1/audit?${this.#time}&format=${kind}`, download: "", text: `download all, ${kind}` })));
    this.#showLines();
  }

  #showLines() {
    const search = this.root.querySelector("input[type=search]").value;
    const shown = this.#lines.filter((line) => holds(search, line.who, line.name, line.text, line.why, line.answer, line.cause));
    put(this.root.querySelector(".count"), `${number(shown.length, 0)} of ${this.#lines.length} lines read`);
    this.root.querySelector("#trail tbody").replaceChildren(...shown.slice(0, 2 * LINES).map((line) => {
      const ms = milliseconds(line.t_ns_utc);
      return make("tr", {},
        make("td", {}, make("time", { datetime: new Date(ms).toISOString(), title: day(ms), text: clock(ms) })),
        make("td", { text: `${line.who}${line.channel && `, ${line.channel}`}`, title: line.address }),
        make("td", { text: `${line.name}: ${line.text}`, title: line.cause }),
        make("td", { text: line.why || DASH }), make("td", { text: line.answer || DASH }));
    }));
  }
}

// For how long each matrix was in use, as the measurements say.
function usedOf(entries) {
  const found = [];
  for (const entry of entries) {
    const at = milliseconds(entry.t_ns_utc);
    const before = found.at(-1);
    if (before?.name === entry.in_use) before.to = at;
    else {
      if (before) before.to = at;
      if (entry.in_use) found.push({ name: entry.in_use, kind: "use", from: at, to: at });
    }
  }
  return found;
}

function notesOf(marks) {
  return marks.filter((mark) => mark.kind === "note").map(({ name, text, t_ns_utc: t }) => {
    const at = milliseconds(t);
    return { name: `${name}: ${text}`, text, kind: "note", from: at, to: at };
  });
}

// For how long each alarm lasted; one that is not over lasts to the end, unless the service began anew.
function lastingOf(marks, end) {
  const [found, open] = [[], new Map()];
  const close = (name, to) => {
    const alarm = open.get(name);
    if (alarm) Object.assign(alarm, { to, open: false });
    open.delete(name);
  };
  for (const mark of marks) {
    const at = milliseconds(mark.t_ns_utc);
    if (mark.kind === "alarm" && !open.has(mark.name)) {
      const alarm = { name: mark.name, text: mark.text, kind: "alarm", from: at, to: end, open: true };
      open.set(mark.name, alarm);
      found.push(alarm);
    } else if (mark.kind === "over") close(mark.name, at);
    else if (mark.kind === "start") [...open.keys()].forEach((name) => close(name, at));
  }
  return found;
}
