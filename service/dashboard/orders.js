// What an operator orders: one click, one dialog that says in numbers what will happen, one answer.

import { DASH, MODES, clock, make, milliseconds, nanometres, number, present, put, registrationOf, verdict } from "./words.js";

const NAME = "pyrcal.name"; // who sits here, kept by this browser

export class Orders {
  #service;
  #dialog = document.querySelector("#order");
  #order = null;
  #key = ""; // of what one dialog orders, however often it is sent

  constructor(service) {
    this.#service = service;
    this.#dialog.querySelector("form").addEventListener("submit", (event) => this.#send(event));
    this.#dialog.querySelector("[value=cancel]").addEventListener("click", () => this.#dialog.close());
  }

  get state() {
    return this.#service.state;
  }

  get proposal() {
    return this.#service.reconstructors.filter((r) => r.state === "proposed").at(-1) ?? null;
  }

  get inUse() {
    return this.#service.reconstructors.find((r) => r.id === this.state?.in_use) ?? null;
  }

  // What a rollback goes back to.
  get before() {
    return this.#service.reconstructors.filter((r) => r.state === "superseded").at(-1) ?? null;
  }

  // What takes long and can be given up, with how far it is; null: nothing of the kind runs.
  get work() {
    const { acquisition, measuring, gathering } = this.state;
    if (acquisition.under_way)
      return { title: `Acquisition, ${acquisition.stage}`, text: acquisition.text, since: acquisition.started_ns_utc, order: "abort", button: "Abort" };
    const one = measuring ?? gathering;
    return one && { title: `Measuring ${one.id}`, text: one.state, since: one.asked_ns_utc, order: "give-up", button: "Give up" };
  }

  // What a proposal wins, by the linear model; null: nobody knows.
  get wins() {
    const { assessment, in_use: inUse } = this.state;
    return assessment?.id === inUse ? assessment.expected.loss_m : null;
  }

  // Why something cannot be ordered now; empty: it can. The service has the last word.
  whyNot(name) {
    if (!this.#service.fresh) return "the connection to the service is lost";
    const { state, work } = this;
    if (BUSY.has(name) && state.stopped_because) return `everything is stopped: ${state.stopped_because}; release it first`;
    const needs = NEEDS[name]?.(this, state) ?? "";
    if (needs || !BUSY.has(name)) return needs;
    if (state.rtc === null) return "no RTC is there";
    return work ? `${work.title.toLowerCase()} is under way: wait for it, or end it` : "";
  }

  open(name, value) {
    const why = this.whyNot(name);
    if (why) {
      this.say(`${TITLES[name] ?? name} cannot be ordered now: ${why}`);
      return;
    }
    if (this.#dialog.open) return;
    this.#order = ORDERS[name](this, value);
    this.#key = newKey();
    const { title, facts, button, asked } = this.#order;
    put(this.#dialog.querySelector("h2"), title);
    this.#dialog.querySelector("ul").replaceChildren(...facts.filter(Boolean).map((text) => make("li", { text })));
    const [reason, by, send] = ["#reason", "#by", "[value=send]"].map((s) => this.#dialog.querySelector(s));
    reason.value = "";
    reason.required = Boolean(asked);
    by.value = localStorage.getItem(NAME) ?? "";
    put(send, button);
    this.#waits(false);
    put(this.#dialog.querySelector(".refused"), "");
    this.#dialog.showModal();
    (asked ? reason : send).focus();
  }

  say(text) {
    put(document.querySelector("#answer"), `${clock(this.#service.now)} UTC, ${text}`);
  }

  async #send(event) {
    event.preventDefault();
    const send = this.#dialog.querySelector("[value=send]");
    if (!this.#order || send.disabled) return; // a second click does nothing twice
    const { title, method, path, body, still } = this.#order;
    if (still && !still()) {
      put(this.#dialog.querySelector(".refused"), "Not sent: what is said above is no longer so. Cancel, and look again.");
      return;
    }
    const reason = this.#dialog.querySelector("#reason").value.trim();
    const by = this.#dialog.querySelector("#by").value.trim();
    localStorage.setItem(NAME, by);
    this.#waits(true);
    const answer = await this.#service.order(method, path, { ...body, reason, by }, this.#key);
    this.#waits(false);
    if (answer.refused) {
      if (!answer.lost) this.#key = newKey(); // it may be sent again, as another order
      put(this.#dialog.querySelector(".refused"), `Refused: ${answer.text}`);
      this.say(`${title}: refused: ${answer.text}`);
      return;
    }
    this.#dialog.close();
    this.say(`${title}: ${answer.text}`);
  }

  #waits(waits) {
    this.#dialog.querySelector("[value=send]").disabled = waits;
    put(this.#dialog.querySelector(".asked"), waits ? "◐ ordered, waiting for what comes of it" : "");
  }
}

function newKey() {
  return `${Date.now()}-${Math.random().toString(36).slice(2)}`;
}

export function described(record, wins = null) {
  const gain = present(wins) ? `, wins ${nanometres(wins)}` : "";
  return `${record.id}: ${record.n_modes} modes${gain}, margin ${verdict(record.gate)}`;
}

// What needs the mirror or the loop, and an RTC.
const BUSY = new Set(["approve", "rollback", "dither-start", "acquire"]);

// What else an order needs: why it cannot be given.
const NEEDS = {
  approve: (orders, state) => {
    if (!orders.proposal) return "no reconstructor is proposed";
    const known = state.registration;
    return known?.validity === "invalid" ? `α is invalid: ${known.validity_reason}` : "";
  },
  reject: (orders) => (orders.proposal ? "" : "no reconstructor is proposed"),
  rollback: (orders, state) => {
    if (!orders.before) return "no earlier reconstructor has been in use";
    return state.waiting_for.some((w) => w.name === "matrix") ? "a reconstructor is being computed: wait for it" : "";
  },
  hold: (orders, state) => (state.mode === "hold" ? "mode is hold already" : ""),
  abort: (orders, state) => (state.acquisition.under_way ? "" : "no acquisition is under way"),
  "give-up": (orders, state) => (state.measuring ?? state.gathering ? "" : "nothing is being measured"),
  stop: (orders, state) => (state.stopped_because ? `everything is stopped already: ${state.stopped_because}` : ""),
  resume: (orders, state) => (state.stopped_because ? "" : "nothing is stopped"),
  "dither-start": (orders, state) => (state.dither ? `${state.dither.id} is running: stop it first` : ""),
};

const TITLES = {
  approve: "Approve", reject: "Reject", rollback: "Roll back", hold: "Hold", mode: "Mode", acquire: "Acquire",
  abort: "Abort the acquisition", "give-up": "Give up", "dither-start": "Start the dither", "dither-stop": "Stop the dither",
  stop: "Stop everything", resume: "Release",
};

const ORDERS = {
  stop(orders) {
    const { dither, mode, in_use: inUse } = orders.state;
    return {
      title: "Stop everything",
      facts: [
        orders.work && `${orders.work.title} is ended.`,
        dither && `${dither.id} is stopped; no other is started.`,
        `Nothing is made or sent, whoever asks (mode is ${mode}); ${inUse ?? "what the RTC uses"} stays in use, telemetry is still looked at.`,
        "It lasts until somebody releases it, over a restart of the service, too. Mode and dither are then as before.",
      ],
      button: "Stop everything",
      method: "POST",
      path: "v1/stop",
    };
  },
  resume(orders) {
    return {
      title: "Release what was stopped",
      facts: [
        `Stopped: ${orders.state.stopped_because}.`,
        `Mode is ${orders.state.mode} again, and it may dither, make and send as that allows.`,
      ],
      button: "Release",
      method: "POST",
      path: "v1/resume",
    };
  },
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
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/approve`,
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
      asked: true,
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/reject`,
    };
  },
  rollback(orders) {
    const { before, inUse, state } = orders;
    return {
      title: `Roll back to ${before.id}`,
      facts: [
        `${before.id}, ${before.n_modes} modes, goes out again under a new id${inUse ? ` in place of ${inUse.id}, ${inUse.n_modes} modes` : ""}.`,
        `Made for ${registrationOf(before.alpha, before.sigma)}.`,
        `When it was judged last: ${verdict(before.gate)}. The gate judges it anew where it can.`,
        state.mode === "hold" ? "Mode stays hold." : `Mode becomes hold (it is ${state.mode}), so that the service does not undo it.`,
      ],
      button: "Roll back",
      asked: true,
      still: () => orders.before?.id === before.id && orders.state.in_use === inUse?.id,
      method: "POST",
      path: "v1/rollback",
    };
  },
  hold: (orders) => ORDERS.mode(orders, "hold"),
  mode(orders, mode) {
    const { proposal, state } = orders;
    return {
      title: `Mode ${mode}`,
      facts: [
        `Mode ${mode}: ${MODES[mode]}. It is ${state.mode} now.`,
        proposal && mode === "auto" && `${proposal.id} waits for an approval; in auto another one is made and sent when it wins enough.`,
        "It stands until it is changed again, over a restart of the service, too.",
      ],
      button: `Set mode ${mode}`,
      method: "PUT",
      path: "v1/mode",
      body: { mode },
    };
  },
  "dither-stop"(orders) {
    const { dither, registration } = orders.state;
    const until = milliseconds(registration?.valid_until_ns_utc);
    return {
      title: "Stop the dither",
      facts: [
        dither ? `${dither.id} is stopped: modes ${dither.modes.slice(0, 8).join(", ")}${dither.modes.length > 8 ? " and more" : ""}.` : "None plays now.",
        "None is started by itself until somebody starts one, over a restart of the service, too.",
        until ? `α is not measured by a dither any more, and stale by ${clock(until)} UTC unless ordinary telemetry keeps it.` : "α is not measured by a dither any more.",
      ],
      button: "Stop the dither",
      method: "POST",
      path: "v1/dither",
      body: { action: "stop" },
    };
  },
  "dither-start"(orders) {
    return {
      title: "Start the dither",
      facts: [
        `The service chooses modes, lines and strength: at most ${nanometres(orders.state.dithering.budget_m)} RMS of all modes together.`,
        "It dithers again by itself from then on, as the settings allow.",
      ],
      button: "Start the dither",
      method: "POST",
      path: "v1/dither",
      body: { action: "start" },
    };
  },
  acquire(orders) {
    const { rtc, registration } = orders.state;
    return {
      title: "Acquire",
      facts: [
        `The loop, now ${rtc.loop} with ${rtc.n_controlled} modes, is opened: the image is lost for some tens of seconds.`,
        "Smooth modes are dithered far above the budget while it is open, until two looks agree where the mirror is.",
        "The loop is closed on at most 150 modes first, then on more; these matrices need no further approval, but pass the gate.",
        registration ? "What is known of α now is given up." : `α is ${DASH}: nothing is lost by it.`,
      ],
      button: "Open the loop and acquire",
      asked: true,
      method: "POST",
      path: "v1/acquisition",
      body: { action: "start" },
    };
  },
  abort(orders) {
    return {
      title: "Abort the acquisition",
      facts: [
        `It is at ${orders.state.acquisition.stage}: ${orders.state.acquisition.text}.`,
        "The loop is left as it was found if that held; else it stays open, or closed on a matrix that passed the gate.",
        "None begins by itself until two windows agree in a closed loop, or the mode is set anew.",
      ],
      button: "Abort",
      method: "POST",
      path: "v1/acquisition",
      body: { action: "abort" },
    };
  },
  "give-up"(orders) {
    const { measuring, gathering } = orders.state;
    const one = measuring ?? gathering;
    return {
      title: `Give up ${one.id}`,
      facts: [
        `${one.id} is ${one.state}; there will be no matrix of it.`,
        measuring && "The RTC may go on to its end, and refuse other commands until then; what it sends is ignored.",
      ],
      button: "Give up",
      method: "DELETE",
      path: `v1/${measuring ? "measurements" : "noisy-matrix"}/${encodeURIComponent(one.id)}`,
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
