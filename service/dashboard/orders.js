// What an operator orders: one click, one dialog that says in numbers what will happen, one answer.

import { MODES, clock, make, nanometres, number, present, put, registrationOf, verdict } from "./words.js";

const OVER = ["applied", "refused", "rejected", "failed", "discarded", "superseded"];
const WATCHED_MS = 30_000;

export class Orders {
  #service;
  #dialog = document.querySelector("#order");
  #order = null;
  #watched = null;

  constructor(service) {
    this.#service = service;
    this.#dialog.querySelector("form").addEventListener("submit", (event) => this.#send(event));
    this.#dialog.querySelector("[value=cancel]").addEventListener("click", () => this.#dialog.close());
    for (const name of ["reconstructors", "state", "tick"]) service.addEventListener(name, () => this.#follow());
  }

  get proposal() {
    return this.#service.reconstructors.filter((r) => r.state === "proposed").at(-1) ?? null;
  }

  get inUse() {
    return this.#service.reconstructors.find((r) => r.id === this.#service.state?.in_use) ?? null;
  }

  // What a rollback goes back to.
  get before() {
    return this.#service.reconstructors.filter((r) => r.state === "superseded").at(-1) ?? null;
  }

  // Why something cannot be ordered now; empty: it can.
  whyNot(name) {
    const { state, fresh } = this.#service;
    if (!fresh) return "the connection to the service is lost";
    if ((name === "approve" || name === "reject") && !this.proposal) return "no reconstructor is proposed";
    if (name === "reject") return "";
    if (name === "hold") return state.mode === "hold" ? "mode is hold already" : "";
    if (name === "mode") return "";
    if (state.rtc === null) return "no RTC is there";
    if (state.acquisition.under_way) return "an acquisition is under way: wait for it, or abort it";
    if (state.measuring) return `${state.measuring.id} is being measured: wait for it, or give it up`;
    if (name === "approve" && state.registration?.validity === "invalid") return `α is invalid: ${state.registration.validity_reason}`;
    if (name === "rollback") {
      if (!this.before) return "no earlier reconstructor has been in use";
      if (state.waiting_for.some((w) => w.name === "matrix")) return "a reconstructor is being computed: wait for it";
    }
    return "";
  }

  open(name, value) {
    const why = this.whyNot(name);
    if (why) {
      this.say(`${TITLES[name](value)} cannot be ordered now: ${why}`);
      return;
    }
    if (this.#dialog.open) return;
    this.#order = ORDERS[name](this, value);
    const { title, facts, button, asks } = this.#order;
    put(this.#dialog.querySelector("h2"), title);
    this.#dialog.querySelector("ul").replaceChildren(...facts.filter(Boolean).map((text) => make("li", { text })));
    const reason = this.#dialog.querySelector("textarea");
    reason.value = "";
    reason.required = asks === "asked";
    reason.parentElement.hidden = !asks;
    const send = this.#dialog.querySelector("[value=send]");
    put(send, button);
    send.disabled = false;
    put(this.#dialog.querySelector(".refused"), "");
    this.#dialog.showModal();
    (asks ? reason : send).focus();
  }

  say(text) {
    put(document.querySelector("#answer"), text);
  }

  async #send(event) {
    event.preventDefault();
    const order = this.#order;
    const send = this.#dialog.querySelector("[value=send]");
    if (!order || send.disabled) return; // a second click does nothing twice
    send.disabled = true;
    const reason = this.#dialog.querySelector("textarea").value.trim();
    const known = new Set(this.#service.reconstructors.map((r) => r.id));
    const answer = await this.#service.order(order.method, order.path, order.body(reason));
    if (answer.refused) {
      put(this.#dialog.querySelector(".refused"), `Refused: ${answer.text}`);
      send.disabled = false;
      return;
    }
    this.#dialog.close();
    this.#watched = { ...order, known, since: performance.now(), at: clock(this.#service.now) };
    this.#follow();
  }

  // Say what came of the last order, once it has come to its end.
  #follow() {
    const order = this.#watched;
    if (!order) return;
    const came = order.outcome(order.known);
    const late = performance.now() - order.since > WATCHED_MS;
    this.say(`${order.at} UTC, ${order.title}: ${came ?? (late ? "nobody has told what came of it: see events" : "ordered, waiting for what comes of it")}`);
    if (came || late) this.#watched = null;
  }

  fate(record) {
    if (!record || !OVER.includes(record.state)) return null;
    const frame = record.applied_frame_seq;
    if (record.state === "applied") return `${record.id} applied${present(frame) ? ` at frame ${frame}` : ""}`;
    return `${record.id} ${record.state}${record.reason && `: ${record.reason}`}`;
  }

  find(id) {
    return this.#service.reconstructors.find((r) => r.id === id);
  }

  // One that was not there when the order was given: a copy under a new id.
  newest(known) {
    return this.#service.reconstructors.filter((r) => !known.has(r.id)).at(-1);
  }

  get mode() {
    return this.#service.state.mode;
  }

  // What a proposal wins, by the linear model; null: nobody knows.
  get wins() {
    const { assessment, in_use: inUse } = this.#service.state;
    return assessment?.id === inUse ? assessment.expected.loss_m : null;
  }
}

export function described(record, wins = null) {
  const gain = present(wins) ? `, wins ${nanometres(wins)}` : "";
  return `${record.id}: ${record.n_modes} modes${gain}, margin ${verdict(record.gate)}`;
}

const TITLES = {
  approve: () => "Approve",
  reject: () => "Reject",
  rollback: () => "Roll back",
  hold: () => "Hold",
  mode: (value) => `Mode ${value}`,
};

const ORDERS = {
  approve(orders) {
    const [record, inUse] = [orders.proposal, orders.inUse];
    return {
      title: `Approve ${record.id}`,
      facts: [
        `The RTC gets ${record.id}, ${record.n_modes} modes, and swaps it in between two frames.`,
        inUse && `It takes the place of ${inUse.id}, ${inUse.n_modes} modes.`,
        `Made for ${registrationOf(record.alpha, record.sigma)}.`,
        `Largest closed-loop pole radius within α ± 3σ: ${verdict(record.gate)}.`,
        present(orders.wins) && `By the linear model it wins ${nanometres(orders.wins)} of wavefront error.`,
        "It is judged again first if the loop has changed, and not sent if it would not hold.",
      ],
      button: "Approve and send",
      asks: "",
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/approve`,
      body: () => undefined,
      outcome: () => orders.fate(orders.find(record.id)),
    };
  },
  reject(orders) {
    const record = orders.proposal;
    return {
      title: `Reject ${record.id}`,
      facts: [
        `${described(record, orders.wins)} is discarded; what is in use stays.`,
        "More modes than are controlled now are then not proposed again for an hour.",
      ],
      button: "Reject",
      asks: "asked",
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/reject`,
      body: (reason) => ({ reason }),
      outcome: () => orders.fate(orders.find(record.id)),
    };
  },
  rollback(orders) {
    const [before, inUse] = [orders.before, orders.inUse];
    return {
      title: `Roll back to ${before.id}`,
      facts: [
        `${before.id}, ${before.n_modes} modes, goes out again under a new id${inUse ? ` in place of ${inUse.id}, ${inUse.n_modes} modes` : ""}.`,
        `Made for ${registrationOf(before.alpha, before.sigma)}.`,
        `When it was judged last: ${verdict(before.gate)}. The gate judges it anew where it can.`,
        orders.mode === "hold" ? "Mode stays hold." : `Mode becomes hold (it is ${orders.mode}), so that the service does not undo it.`,
      ],
      button: "Roll back",
      asks: "",
      method: "POST",
      path: "v1/rollback",
      body: () => undefined,
      outcome: (known) => orders.fate(orders.newest(known)),
    };
  },
  hold: (orders) => ORDERS.mode(orders, "hold"),
  mode(orders, value) {
    const proposal = orders.proposal;
    return {
      title: `Mode ${value}`,
      facts: [
        `Mode ${value}: ${MODES[value]}. It is ${orders.mode} now.`,
        proposal && value === "auto" && `${proposal.id} waits for an approval; in auto another one is made and sent when it wins enough.`,
        "It stands until it is changed again, over a restart of the service, too.",
      ],
      button: `Set mode ${value}`,
      asks: "",
      method: "PUT",
      path: "v1/mode",
      body: () => ({ mode: value }),
      outcome: () => (orders.mode === value ? `mode is ${value}` : null),
    };
  },
};

// A button that can be used, or says why not.
export function usable(button, why) {
  button.setAttribute("aria-disabled", String(Boolean(why)));
  button.title = why ? `cannot be used now: ${why}` : "";
}

export function margin(gate) {
  if (!gate || !present(gate.worst_pole_radius)) return null;
  return { radius: gate.worst_pole_radius, bound: gate.bound, text: `${number(gate.worst_pole_radius, 3)} of ${number(gate.bound, 2)}` };
}
