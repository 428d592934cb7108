// What happened: alarms stay on top for as long as they last, the log below them, newest first.

import { ago, clock, day, make, milliseconds, put } from "./words.js";

const MOST = 500;
const SHAPES = { alarm: "■", warning: "▲", info: "·" };

export class Events {
  #service;
  #lines = new Map(); // by what makes it this line and no other
  #alarms = "";
  #told = new Set();

  constructor(service, root) {
    this.#service = service;
    this.root = root;
    this.filter = root.querySelector("input");
    this.level = root.querySelector("select");
    this.filter.addEventListener("input", () => this.#show());
    this.level.addEventListener("change", () => this.#show());
    service.addEventListener("log", (event) => this.#add(event.detail));
    service.addEventListener("reset", () => this.#lines.clear());
    service.addEventListener("state", () => this.#showAlarms());
    service.addEventListener("tick", () => this.#age());
  }

  #add(lines) {
    for (const line of lines) this.#lines.set(`${line.t_ns_utc} ${line.name} ${line.text}`, line);
    for (const key of [...this.#lines.keys()].slice(0, Math.max(0, this.#lines.size - MOST))) this.#lines.delete(key);
    this.#show();
  }

  #show() {
    const words = this.filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const levels = { all: ["info", "warning", "alarm"], warning: ["warning", "alarm"], alarm: ["alarm"] }[this.level.value];
    const shown = [...this.#lines.values()].reverse().filter((line) => {
      const text = `${line.name} ${line.text}`.toLowerCase();
      return levels.includes(line.level) && words.every((word) => text.includes(word));
    });
    const rows = shown.slice(0, 200).map((line) => {
      const ms = milliseconds(line.t_ns_utc);
      const text = line.n_times > 1 ? `${line.text} (${line.n_times} times)` : line.text;
      return make("tr", { className: line.level },
        make("td", {}, make("time", { datetime: new Date(ms).toISOString(), title: day(ms), text: clock(ms) })),
        make("td", { text: `${SHAPES[line.level]} ${line.level}` }),
        make("td", { text: line.name }),
        make("td", { text }));
    });
    this.root.querySelector("tbody").replaceChildren(...rows);
    put(this.root.querySelector(".count"), `${shown.length} of ${this.#lines.size} lines`);
  }

  #showAlarms() {
    const { alarms } = this.#service.state;
    const told = JSON.stringify(alarms);
    if (told === this.#alarms) return;
    this.#alarms = told;
    const newest = [...alarms].sort((a, b) => b.since_ns_utc - a.since_ns_utc);
    this.root.querySelector("#alarms").replaceChildren(...newest.map((alarm) => make("li", {},
      make("strong", { text: `■ ${alarm.name}` }),
      make("span", { className: "since", data_since: String(milliseconds(alarm.since_ns_utc)) }),
      make("span", { text: alarm.text }))));
    this.#age();
    this.#announce(alarms);
  }

  // Screen readers hear of each alarm once, and of its end.
  #announce(alarms) {
    const now = new Set(alarms.map((alarm) => alarm.name));
    const begun = alarms.filter((alarm) => !this.#told.has(alarm.name)).map((alarm) => `Alarm ${alarm.name}: ${alarm.text}`);
    const over = [...this.#told].filter((name) => !now.has(name)).map((name) => `Alarm ${name} is over`);
    this.#told = now;
    if (begun.length || over.length) put(document.querySelector("#live"), [...begun, ...over].join(". "));
  }

  #age() {
    for (const since of this.root.querySelectorAll(".since")) {
      const ms = Number(since.dataset.since);
      put(since, `since ${clock(ms)} UTC, ${ago(ms, this.#service.now)}`);
    }
  }
}
