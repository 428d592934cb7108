// What an operator orders: one click, one dialog that says in numbers what will happen, one answer.

import { unseen } from "./alarms.js";
import { busy } from "./work.js";
import { DASH, MODES, SYMBOLS, clock, make, milliseconds, nanometres, number, present, put, registrationOf, verdict } from "./words.js";

const NAME = "pyrcal.name"; // who sits here, kept by this browser
const READ_WITHIN_S = 3; // what an order is about

export class Orders {
  #service;
  #dialog = document.querySelector("#order");
  #order = null;
  #key = ""; // of what one dialog orders, however often it is sent
  #opening = false;

  constructor(service) {
    this.#service = service;
    const form = this.#dialog.querySelector("form");
    form.addEventListener("submit", (event) => this.#send(event));
    form.addEventListener("keydown", (event) => this.#onKey(event));
    form.addEventListener("invalid", (event) => this.#onLack(event), true);
    this.#dialog.querySelector("[value=cancel]").addEventListener("click", () => this.#dialog.close());
  }

  get service() {
    return this.#service;
  }

  // Whether a dialog is on its way: what is typed already is meant for it.
  get opening() {
    return this.#opening;
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

  // The matrix that a rollback sends again: as in the service, one of the sensor's mode of now.
  get before() {
    return beforeOf(this.#service.reconstructors, this.state?.config_id);
  }

  // What takes long and can be ended, with how far it is; null: nothing of the kind runs.
  get work() {
    return busy(this.state, this.#service.now);
  }

  // What a proposal wins, by the linear model; null: nobody knows.
  get wins() {
    const { assessment, in_use: inUse } = this.state;
    return assessment?.id === inUse ? assessment.expected.loss_m : null;
  }

  // Orders of a page of its own: how each is called, here and in the state, and what its dialog says.
  learn(orders) {
    for (const [name, { title, permitted, about, make: made }] of Object.entries(orders)) {
      TITLES[name] = title;
      PERMITTED[name] = permitted;
      if (about) DECIDED_ON[name] = about;
      ORDERS[name] = made;
    }
  }

  // Why something cannot be ordered now, in the words of the service; empty: it can.
  whyNot(name) {
    if (this.#service.forbidden) return this.#service.forbidden;
    if (!this.#service.fresh) return "the connection to the service is lost";
    return this.state.permitted[PERMITTED[name]]?.reason ?? "";
  }

  async open(name, value) {
    if (this.#dialog.open || this.#opening) return;
    const why = this.whyNot(name);
    if (why) {
      this.say(`${TITLES[name] ?? name} is not possible now: ${why}`);
      return;
    }
    this.#opening = true;
    try {
      await this.#look(name, value);
    } catch (error) {
      this.say(`${TITLES[name] ?? name} is not possible now: ${error.message}`);
      return;
    } finally {
      this.#opening = false;
    }
    const { button, asked } = this.#order;
    const [reason, by, send] = ["#reason", "#by", "[value=send]"].map((s) => this.#dialog.querySelector(s));
    reason.value = "";
    reason.required = Boolean(asked);
    put(reason.parentElement.querySelector(".need"), need(asked));
    by.value = localStorage.getItem(NAME) ?? "";
    put(send.querySelector("span"), button);
    this.#waits(false);
    put(this.#dialog.querySelector(".refused"), "");
    this.#dialog.showModal();
    // never what sends: somebody may be typing already
    (this.#dialog.querySelector(".choices input[type=text]:required") ?? reason).focus();
  }

  // Enter in a field is not an order; Ctrl+Enter is, wherever the focus is.
  #onKey(event) {
    if (event.key !== "Enter" || event.isComposing || event.target.tagName === "BUTTON" && !event.ctrlKey) return;
    event.preventDefault();
    if (event.ctrlKey || event.metaKey) this.#dialog.querySelector("form").requestSubmit();
    else put(this.#dialog.querySelector(".asked"), "Ctrl+Enter sends");
  }

  // What is lacking is said in the dialog, once, by the first field that lacks it.
  #onLack(event) {
    event.preventDefault();
    const field = event.target;
    if (field !== this.#dialog.querySelector(":invalid:not(form)")) return;
    const label = field.parentElement.querySelector("span").firstChild.textContent.trim();
    put(this.#dialog.querySelector(".refused"), field.validity.valueMissing ? `Not sent: ${label} is required` : `Not sent: ${label}: ${field.validationMessage}`);
    field.focus();
  }

  // Say what will happen, from what is there now; what is decided on is read for it, with its tag.
  async #look(name, value) {
    const about = await this.#aboutWhat(name, value);
    const seen = about && (await this.#service.seen(about));
    this.#order = { ...ORDERS[name](this, value, seen?.body), name, value, tag: seen?.tag };
    this.#key = newKey();
    put(this.#dialog.querySelector("h2"), this.#order.title);
    const fields = (this.#order.fields ?? []).map(fieldOf);
    const choices = this.#dialog.querySelector(".choices");
    choices.replaceChildren(...fields);
    choices.oninput = () => this.#tell();
    this.#tell();
  }

  // The list of reconstructors comes a moment after the state that permits an order about one.
  async #aboutWhat(name, value) {
    for (let left = READ_WITHIN_S; ; left -= 0.1) {
      try {
        return DECIDED_ON[name]?.(this, value);
      } catch (error) {
        if (left <= 0) throw error;
      }
      await new Promise((resolve) => setTimeout(resolve, 100));
    }
  }

  // What was chosen in this dialog, by name; what was left empty is left out.
  get #chosen() {
    const fields = [...this.#dialog.querySelectorAll(".choices :is(input, select)")].filter((f) => f.value !== "");
    return Object.fromEntries(fields.map((f) => [f.name, f.type === "number" ? Number(f.value) : f.value]));
  }

  #tell() {
    const { facts } = this.#order;
    const lines = typeof facts === "function" ? facts(this.#chosen) : facts;
    this.#dialog.querySelector("ul").replaceChildren(...lines.filter(Boolean).map((text) => make("li", { text })));
  }

  say(text) {
    put(document.querySelector("#answer"), `${clock(this.#service.now)} UTC, ${text}`);
  }

  async #send(event) {
    event.preventDefault();
    const send = this.#dialog.querySelector("[value=send]");
    if (!this.#order || send.disabled) return; // a second click does nothing twice
    const { title, parts, method, path, body, tag } = this.#order;
    const chosen = typeof body === "function" ? body(this.#chosen) : { ...body, ...this.#chosen };
    const reason = this.#dialog.querySelector("#reason").value.trim();
    const by = this.#dialog.querySelector("#by").value.trim();
    localStorage.setItem(NAME, by);
    this.#waits(true);
    const answer = parts ? await this.#sendAll(parts, { reason, by })
      : await this.#service.order(method, path, { ...chosen, reason, by }, this.#key, tag);
    this.#waits(false);
    if (answer.stale) return this.#again();
    if (answer.refused) {
      if (!answer.lost) this.#key = newKey(); // it may be sent again, as another order
      put(this.#dialog.querySelector(".refused"), `Refused: ${answer.text}`);
      this.say(`${title}: refused: ${answer.text}`);
      return;
    }
    this.#dialog.close();
    this.say(`${title}: ${answer.text}`);
  }

  // Several orders of one dialog: what was refused is told, and stays on the page.
  async #sendAll(parts, signed) {
    const refused = [];
    for (const { path, body, name } of parts) {
      const answer = await this.#service.order("POST", path, { ...body, ...signed }, `${this.#key}-${name}`);
      if (answer.refused) refused.push(`${name}: ${answer.text}`);
    }
    const done = parts.length - refused.length;
    return { refused: false, text: [`${done} of ${parts.length} done`, ...refused].join("; ") };
  }

  // Nothing was done: somebody, or the service, was faster. The dialog says how it is now.
  async #again() {
    const { name, value, title } = this.#order;
    let why = this.whyNot(name);
    if (!why) await this.#look(name, value).catch((error) => (why = error.message));
    const text = why ? `it is not possible now: ${why}. Cancel and try again.` : "the dialog shows the new state; send or cancel.";
    put(this.#dialog.querySelector(".refused"), `The state has changed, and nothing was sent; ${text}`);
    this.#dialog.querySelector("[value=send]").disabled = Boolean(why);
    this.say(`${title}: nothing was sent, because the state had changed`);
  }

  #waits(waits) {
    this.#dialog.querySelector("[value=send]").disabled = waits;
    put(this.#dialog.querySelector(".asked"), waits ? "◐ sent, waiting for the result" : "");
  }
}

// One field of a dialog: a choice of some, or a number; which are needed is said, not only shown.
function fieldOf({ name, label, options, value = "", needed = false, ...rest }) {
  const input = options
    ? make("select", { name }, ...options.map(([key, text]) => make("option", { value: key, text })))
    : make("input", { name, type: "number", autocomplete: "off", ...rest });
  input.value = value;
  input.required = needed;
  return make("label", {}, make("span", { text: `${label} ` }, make("em", { className: "need", text: options && !needed ? "" : need(needed) })), input);
}

function need(needed) {
  return needed ? "required" : "optional";
}

function newKey() {
  return `${Date.now()}-${Math.random().toString(36).slice(2)}`;
}

function needs(so, otherwise) {
  if (!so) throw new Error(otherwise);
}

function beforeOf(reconstructors, configId) {
  const fits = (r) => (r.config_id ?? configId) === configId;
  return reconstructors.filter((r) => r.state === "superseded" && fits(r)).at(-1) ?? null;
}

export function described(record, wins = null) {
  const gain = present(wins) ? `, wins ${nanometres(wins)}` : "";
  return `${record.id}: ${record.n_modes} modes${gain}, margin ${verdict(record.gate)}`;
}

// What each order is called in the state that the service publishes; the others need no permission.
const PERMITTED = {
  approve: "approve", reject: "reject", rollback: "rollback", hold: "set_mode", mode: "set_mode", acquire: "acquire",
  abort: "abort_acquisition", "give-up": "give_up", "dither-start": "start_dither", "dither-stop": "stop_dither",
  stop: "stop_everything", resume: "resume", measure: "measure", noisy: "measure_noisy", "open-loop": "open_loop",
  acknowledge: "acknowledge_alarm", "acknowledge-all": "acknowledge_alarm", mute: "mute_alarm", unmute: "unmute_alarm",
};

function pathOf(record) {
  needs(record, "the reconstructors are still loading: try again");
  return `v1/reconstructors/${encodeURIComponent(record.id)}`;
}

// What of REST an order decides about: it is sent with the tag of what was seen of that.
const DECIDED_ON = {
  approve: (orders) => pathOf(orders.proposal),
  reject: (orders) => pathOf(orders.proposal),
  rollback: (orders) => pathOf(orders.before),
};

// The alarm of this name, whether it lasts, went unseen, or is only muted.
function alarmOf(state, name) {
  const known = [...state.alarms, ...state.stale_alarms].find((alarm) => alarm.name === name);
  return known ?? state.muted_alarms.find((alarm) => alarm.name === name);
}

const TITLES = {
  approve: "Approve", reject: "Reject", rollback: "Roll back", hold: "Hold", mode: "Mode", acquire: "Acquire",
  abort: "Abort the acquisition", "give-up": "Cancel the measurement", "dither-start": "Start the dither", "dither-stop": "Stop the dither",
  stop: "Stop everything", resume: "End the stop", measure: "Measure", noisy: "Noisy matrix", record: "Record telemetry", "open-loop": "End the gain ramp",
  acknowledge: "Acknowledge", "acknowledge-all": "Acknowledge all", mute: "Mute", unmute: "Unmute",
};

const MUTE_TIMES = [["", "choose"], ["900", "15 minutes"], ["3600", "an hour"], ["14400", "4 hours"], ["43200", "12 hours"]];

const ORDERS = {
  stop(orders) {
    const { dither, mode, in_use: inUse } = orders.state;
    return {
      title: "Stop everything",
      facts: [
        orders.work && `${orders.work.title} is ended.`,
        dither && `${dither.id} is stopped; no other one starts.`,
        `Nothing is computed or sent, even on order (mode is ${mode}). ${inUse ?? "The present matrix"} stays in use, and telemetry is still used.`,
        "The stop lasts until you end it, also over a restart of the service. Mode and dither are then as before.",
      ],
      button: "Stop everything",
      method: "POST",
      path: "v1/stop",
    };
  },
  acknowledge(orders, name) {
    const alarm = alarmOf(orders.state, name);
    needs(alarm?.alarm_state, `${name} is over`);
    const lasts = Boolean(alarm.severity);
    return {
      title: `Acknowledge ${name}`,
      facts: [
        alarm.text,
        alarm.do && `What to do: ${alarm.do}`,
        lasts ? "It stays on this page, with your name, until it is over." : "It is over and was not acknowledged. It leaves this page.",
        lasts && "If it becomes more severe, it must be acknowledged again.",
      ],
      button: "Acknowledge",
      method: "POST",
      path: `v1/alarms/${encodeURIComponent(name)}/acknowledge`,
      body: { severity: alarm.worst_severity },
    };
  },
  // Each as it was seen here: one that has become worse meanwhile is refused.
  "acknowledge-all"(orders) {
    const alarms = unseen(orders.state);
    return {
      title: `Acknowledge ${alarms.length} alarms`,
      facts: [
        ...alarms.map((alarm) => `${alarm.severity ? SYMBOLS[alarm.severity] : SYMBOLS.over} ${alarm.name}${alarm.severity ? "" : " (over)"}: ${alarm.text}`),
        "Active alarms stay on this page, with your name; those that are over leave it.",
      ],
      button: "Acknowledge all",
      parts: alarms.map(({ name, worst_severity: severity }) => ({ name, path: `v1/alarms/${encodeURIComponent(name)}/acknowledge`, body: { severity } })),
    };
  },
  mute(orders, name) {
    const alarm = alarmOf(orders.state, name);
    needs(alarm, `${name} is over`);
    return {
      title: `Mute ${name}`,
      fields: [{ name: "for_s", label: "For", options: MUTE_TIMES, needed: true }],
      facts: ({ for_s: seconds }) => [
        alarm.text,
        `It is hidden until ${seconds ? `${clock(orders.service.now + seconds * 1000)} UTC` : DASH}, even if it occurs again; muted alarms are counted.`,
        "What it forbids stays forbidden.",
      ],
      button: "Mute",
      asked: true,
      method: "POST",
      path: `v1/alarms/${encodeURIComponent(name)}/mute`,
      body: ({ for_s: seconds }) => ({ for_s: Number(seconds) }),
    };
  },
  unmute(orders, name) {
    const muted = alarmOf(orders.state, name)?.muted;
    needs(muted, `${name} is not muted`);
    return {
      title: `Unmute ${name}`,
      facts: [`${muted.by} muted it${muted.reason ? `: ${muted.reason}` : ""}. It is shown again from now on.`],
      button: "Unmute",
      method: "POST",
      path: `v1/alarms/${encodeURIComponent(name)}/unmute`,
    };
  },
  resume(orders) {
    return {
      title: "End the stop",
      facts: [
        `Stopped: ${orders.state.stopped_because}.`,
        `Mode is ${orders.state.mode} again; the service dithers, computes and sends as it allows.`,
      ],
      button: "End the stop",
      method: "POST",
      path: "v1/resume",
    };
  },
  approve(orders, _, record) {
    const { inUse } = orders;
    needs(record.state === "proposed", `${record.id} is ${record.state}`);
    return {
      title: `Approve ${record.id}`,
      facts: [
        `The RTC receives ${record.id}, ${record.n_modes} modes, and applies it between two frames.`,
        inUse && `It replaces ${inUse.id}, ${inUse.n_modes} modes.`,
        `Computed for ${registrationOf(record.alpha, record.sigma)}.`,
        `Largest closed-loop pole radius within α ± 3σ: ${verdict(record.gate)}.`,
        present(orders.wins) && `According to the linear model it reduces the wavefront error by ${nanometres(orders.wins)}.`,
        "If the loop has changed, it is checked again before, and not sent if it would be unstable.",
        orders.state.no_return && `A rollback will not be possible: ${orders.state.no_return}.`,
      ],
      button: "Approve and send",
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/approve`,
    };
  },
  reject(orders, _, record) {
    needs(record.state === "proposed", `${record.id} is ${record.state}`);
    return {
      title: `Reject ${record.id}`,
      facts: [
        `${described(record, orders.wins)} is discarded; the matrix in use stays.`,
        "For an hour, no matrix with more modes than now is proposed.",
      ],
      button: "Reject",
      asked: true,
      method: "POST",
      path: `v1/reconstructors/${encodeURIComponent(record.id)}/reject`,
    };
  },
  rollback(orders, _, before) {
    const { state, inUse } = orders;
    return {
      title: `Roll back to ${before.id}`,
      facts: [
        `${before.id}, ${before.n_modes} modes, is sent again under a new id${inUse ? ` in place of ${inUse.id}, ${inUse.n_modes} modes` : ""}.`,
        before.alpha ? `Computed for ${registrationOf(before.alpha, before.sigma)}.` : `It is ${before.origin}.`,
        `Last stability check: ${verdict(before.gate)}. It is checked again if possible.`,
        state.mode === "hold" ? "Mode stays hold." : `Mode becomes hold (it is ${state.mode}), so that the service does not undo it.`,
      ],
      fields: [{
        name: "anyway",
        label: "If the check refuses it",
        options: [["", "nothing is sent"], ["yes", "it is sent all the same (if α is wrong)"]],
      }],
      button: "Roll back",
      asked: true,
      method: "POST",
      path: "v1/rollback",
      body: ({ anyway }) => (anyway ? { anyway: true } : {}),
    };
  },
  hold: (orders) => ORDERS.mode(orders, "hold"),
  mode(orders, mode) {
    const { proposal, state } = orders;
    return {
      title: `Mode ${mode}`,
      facts: [
        `Mode ${mode}: ${MODES[mode]}. It is ${state.mode} now.`,
        proposal && mode === "auto" && `${proposal.id} waits for an approval; in auto another one is computed and sent when it improves enough.`,
        "It lasts until it is changed, also over a restart of the service.",
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
        dither ? `${dither.id} is stopped: modes ${dither.modes.slice(0, 8).join(", ")}${dither.modes.length > 8 ? " and more" : ""}.` : "No dither is playing now.",
        "None starts by itself until you start one, also over a restart of the service.",
        until ? `α is no longer measured, and stale after ${clock(until)} UTC unless telemetry without dither keeps it.` : "α is no longer measured by a dither.",
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
        `The service chooses modes, frequencies and amplitudes: at most ${nanometres(orders.state.dither_policy.budget_m)} RMS of all modes together.`,
        "From then on it dithers by itself, as the settings allow.",
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
        "Smooth modes are dithered far above the budget while it is open, until two windows agree on the registration.",
        "The loop is closed with at most 150 modes first, then with more. These matrices need no approval, but must pass the stability check.",
        registration ? "The present α is discarded." : "α is not known, so none is lost.",
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
        "The loop returns to its former state if that was stable; otherwise it stays open, or closed with a matrix that passed the stability check.",
        "None begins by itself until two windows agree in a closed loop, or the mode is set again.",
      ],
      button: "Abort",
      method: "POST",
      path: "v1/acquisition",
      body: { action: "abort" },
    };
  },
  "give-up"(orders) {
    const { measuring, noisy_measurement } = orders.state;
    const one = measuring ?? noisy_measurement;
    return {
      title: `Cancel ${one.id}`,
      facts: [
        `${one.id} is ${one.state}; its matrix is discarded.`,
        measuring && "The RTC may finish the measurement, and refuse other commands until then.",
      ],
      button: "Cancel the measurement",
      method: "DELETE",
      path: `v1/${measuring ? "measurements" : "noisy-matrix"}/${encodeURIComponent(one.id)}`,
    };
  },
  "open-loop"(orders) {
    needs(orders.work?.order === "open-loop", "no gain ramp is under way");
    return {
      title: "End the gain ramp",
      facts: [
        `${orders.work.text}: the RTC ends it only when its loop opens.`,
        "The loop is opened: the image is lost until it is closed again. The gains stay as the ramp has set them.",
      ],
      button: "Open the loop",
      asked: true,
      method: "POST",
      path: "v1/loop",
      body: { loop: "open" },
    };
  },
  measure(orders) {
    const { rtc } = orders.state;
    return {
      title: "Measure an interaction matrix",
      fields: [
        { name: "pattern", label: "Pattern", options: Object.entries(PATTERNS), value: "push-pull-modal" },
        { name: "modes", label: "First N modes", min: 1, max: rtc.n_modes, placeholder: `the ${rtc.n_controlled} controlled` },
        { name: "n_average", label: "Repetitions", min: 1, max: 10_000, placeholder: "the service chooses" },
      ],
      facts: ({ pattern, modes }) => [
        pattern === "sine"
          ? "The loop stays as it is; each mode moves at its own frequency, all at once, for about 10 s."
          : `The loop, now ${rtc.loop}, is opened: the image is lost until the RTC has measured, seconds to minutes, and closes it again.`,
        `Moving: ${modes ?? (pattern === "sine" ? "up to 40" : rtc.n_controlled)} modes, by some nanometres RMS each.`,
        "No dither and no new reconstructor meanwhile. The reconstructor in use stays; the measured matrix is never sent to the RTC.",
      ],
      button: "Measure",
      asked: true,
      method: "POST",
      path: "v1/measurements",
      body: ({ modes, n_average: n, pattern }) => ({
        pattern,
        ...(modes && { modes: [...Array(modes).keys()] }),
        ...(n && pattern !== "sine" && { n_average: n }),
      }),
    };
  },
  record() {
    return {
      title: "Record telemetry",
      fields: [
        { name: "duration_s", label: "Seconds from now on", needed: true, min: 0, max: 3600, step: "any", value: 60 },
        { name: "before_s", label: "Seconds before", needed: true, min: 0, max: 3600, step: "any", value: 60 },
      ],
      facts: ({ duration_s: seconds = 0, before_s: before = 0 }) => [
        `Everything that the RTC sends in the next ${number(seconds, 0)} s is archived, byte for byte.`,
        before > 0 ? `The last ${number(before, 0)} s are included, as far as the service still has them (usually a minute).` : "It starts now.",
        "The recording stays until it is removed. It ends early if the disk is nearly full.",
      ],
      button: "Start",
      asked: true,
      method: "POST",
      path: "v1/recordings",
    };
  },
  noisy(orders) {
    const { rtc, dither_policy } = orders.state;
    return {
      title: "Measure a noisy interaction matrix",
      fields: [{ name: "duration_s", label: "Seconds", needed: true, min: 1, max: 3600, step: "any", value: 30 }],
      facts: ({ duration_s: seconds }) => [
        `The loop stays closed: random signs on its ${rtc.n_controlled} modes at once for ${number(seconds, 0)} s of telemetry.`,
        `Moving: at most ${nanometres(Math.min(5e-9, dither_policy.budget_m))} RMS of all modes together; the dither of the service is stopped meanwhile.`,
        "Its windows are fitted like any other. The matrix never becomes a reconstructor.",
      ],
      button: "Start",
      method: "POST",
      path: "v1/noisy-matrix",
    };
  },
};

const PATTERNS = {
  "push-pull-modal": "push-pull, mode by mode (loop open)",
  "push-pull-zonal": "push-pull, actuator by actuator (loop open)",
  hadamard: "Hadamard, all modes at once (loop open)",
  "system-modes": "push-pull of the loop's own modes (loop open)",
  sine: "sines, all modes at once (loop as it is)",
};

// A button that can be used, or says why not.
export function usable(button, why) {
  button.setAttribute("aria-disabled", String(Boolean(why)));
  button.title = why ? `not possible now: ${why}` : "";
}

export function margin(gate) {
  if (!gate || !present(gate.worst_pole_radius)) return null;
  return { radius: gate.worst_pole_radius, bound: gate.bound, text: `${number(gate.worst_pole_radius, 3)} of ${number(gate.bound, 2)}` };
}
