// The state in letters that are read from three metres: what it does, and the few figures that say whether all is well.

import { lasting } from "./alarms.js";
import { margin } from "./orders.js";
import { DASH, SYMBOLS, ago, clock, make, milliseconds, nanometres, number, operation, put, toneOf } from "./words.js";

export class Large {
  #service;
  #orders;

  constructor(service, orders, root) {
    this.#service = service;
    this.#orders = orders;
    this.root = root;
    this.rows = Object.fromEntries(["loop", "α", "wavefront", "stability", "frames", "alarms", "waiting for"].map((label) => {
      const value = make("dd", { text: DASH });
      root.querySelector("dl").append(make("dt", { text: label }), value);
      return [label, value];
    }));
  }

  show() {
    if (this.root.hidden) return;
    const { state, fresh, now } = this.#service;
    const does = this.root.querySelector(".does");
    const { word, symbol, tone } = fresh ? operation(state) : { word: "NOT KNOWN", symbol: SYMBOLS.lost, tone: "bad" };
    put(does, `${symbol} ${word}`);
    does.dataset.tone = tone;
    put(this.root.querySelector(".clock"), `${clock(now)} UTC`);
    const lines = fresh ? this.#lines() : {};
    for (const [label, value] of Object.entries(this.rows)) {
      const [text, tone] = lines[label] ?? [DASH, ""];
      put(value, text);
      value.dataset.tone = tone ?? "";
    }
  }

  #lines() {
    const { state, now } = this.#service;
    const { rtc, link, registration: known, assessment, in_use: inUse } = state;
    const expected = assessment?.id === inUse ? assessment?.expected : null;
    const alarms = lasting(state);
    const waits = state.waiting_for[0];
    const age = known && ago(milliseconds(known.t_ns_utc), now, true);
    return {
      loop: rtc ? [`${rtc.loop}, ${rtc.n_controlled} modes`, rtc.loop === "open" ? "warn" : ""] : ["no RTC", "warn"],
      α: known ? [`${known.validity}, ${age}`, known.validity === "fresh" ? "" : "warn"] : ["not known", "warn"],
      wavefront: [expected ? nanometres(expected.wavefront_m) : DASH],
      stability: [margin(state.margin)?.text ?? DASH, state.margin && !state.margin.accepted ? "bad" : ""],
      frames: rtc ? [`${number(rtc.frame_rate_hz, 0)} Hz, ${link.frames_lost} lost`] : [DASH],
      alarms: alarms.length ? [alarms.map((a) => `${SYMBOLS[a.severity]} ${a.name}`).join(", "), toneOf(alarms[0].severity)] : ["none"],
      "waiting for": this.#orders.proposal ? ["you: approve or reject"] : [waits ? `${waits.responsible}: ${waits.name}` : "nothing"],
    };
  }
}
