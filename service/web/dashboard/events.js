// What happened: alarms stay on top for as long as they last, the log below them, newest first.

import { runbookOf, unseen, worstFirst } from "./alarms.js";
import { SYMBOLS, ago, clock, day, holds, make, milliseconds, put, toneOf } from "./words.js";

const MOST = 500;
function about(order, name, text) {
  return make("button", { type: "button", data_about: order, data_name: name, aria_label: `${text} ${name}`, text });
}

function lineOf(alarm) {
  const { name, acknowledged: seen, worst_severity: worst, over_ns_utc: over } = alarm;
  const word = alarm.severity ?? `over, was ${worst}`;
  const been = alarm.severity && alarm.severity !== worst ? `, has been ${worst}` : "";
  const known = seen && `acknowledged by ${seen.by} at ${clock(milliseconds(seen.t_ns_utc))} UTC${seen.reason ? `: ${seen.reason}` : ""}`;
  const runbook = runbookOf(name);
  return make("li", { className: alarm.alarm_state, title: alarm.do, data_tone: over ? "" : toneOf(alarm.severity) },
    make("strong", { text: `${over ? SYMBOLS.over : SYMBOLS[alarm.severity]} ${name}` }),
    make("span", { text: `${word}${been}` }),
    make("span", { className: "since", data_since: String(milliseconds(alarm.since_ns_utc)) }),
    make("span", { className: "buttons" }, ...(runbook ? [make("a", { href: runbook, target: "_blank", rel: "noopener", text: "Runbook", aria_label: `Runbook: ${name}` })] : []), ...(seen ? [] : [about("acknowledge", name, "Acknowledge")]), about("mute", name, "Mute")),
    make("span", { className: "says", text: alarm.text }),
    ...(known ? [make("span", { className: "says", text: known })] : []));
}

function mutedLine({ name, muted }) {
  const why = muted.reason ? `: ${muted.reason}` : "";
  return make("li", { className: "muted" },
    make("strong", { text: `${SYMBOLS.muted} ${name}` }),
    make("span", { text: `muted by ${muted.by} until ${clock(milliseconds(muted.until_ns_utc))} UTC${why}` }),
    make("span", { className: "buttons" }, about("unmute", name, "Unmute")));
}

export class Events {
  #service;
  #lines = new Map(); // by what makes it this line and no other
  #alarms = "";
  #told = new Set();

  constructor(service, orders, root) {
    this.#service = service;
    root.querySelector("#alarms").addEventListener("click", ({ target }) => {
      const { about, name } = target.dataset;
      if (about) orders.open(about, name);
    });
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
    const levels = { all: ["info", "warning", "alarm"], warning: ["warning", "alarm"], alarm: ["alarm"] }[this.level.value];
    const shown = [...this.#lines.values()].reverse().filter((line) =>
      levels.includes(line.level) && holds(this.filter.value, line.name, line.text, line.cause));
    const rows = shown.slice(0, 200).map((line) => {
      const ms = milliseconds(line.t_ns_utc);
      const text = line.n_times > 1 ? `${line.text} (${line.n_times} times)` : line.text;
      return make("tr", { className: line.level },
        make("td", {}, make("time", { datetime: new Date(ms).toISOString(), title: day(ms), text: clock(ms) })),
        make("td", { text: `${SYMBOLS[line.level]} ${line.level}` }),
        make("td", { text: line.name, title: line.cause }),
        make("td", { text }));
    });
    this.root.querySelector("tbody").replaceChildren(...rows);
    put(this.root.querySelector(".count"), `${shown.length} of ${this.#lines.size} lines`);
  }

  #showAlarms() {
    const { alarms, stale_alarms: stale, muted_alarms: muted } = this.#service.state;
    const told = JSON.stringify([alarms, stale, muted]);
    if (told === this.#alarms) return;
    this.#alarms = told;
    const shown = [...alarms, ...stale].filter((alarm) => !alarm.muted).sort(worstFirst);
    const list = this.root.querySelector("#alarms");
    const focus = document.activeElement?.closest?.("#alarms button")?.dataset; // a rebuilt list keeps it
    list.replaceChildren(...shown.map(lineOf), ...muted.map(mutedLine));
    const n = unseen(this.#service.state).length;
    this.root.querySelector("#unseen").hidden = n < 2;
    put(this.root.querySelector("#unseen span"), `${n} not acknowledged`);
    if (focus) list.querySelector(`[data-about="${focus.about}"][data-name="${focus.name}"]`)?.focus();
    this.#age();
    this.#announce(alarms.filter((alarm) => !alarm.muted));
  }

  // Screen readers hear of each alarm once, and of its end.
  #announce(alarms) {
    const now = new Set(alarms.map((alarm) => alarm.name));
    const begun = alarms.filter((alarm) => !this.#told.has(alarm.name)).map((alarm) => `Alarm ${alarm.name}, ${alarm.severity}: ${alarm.text}`);
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
