// The shape that the loop holds by reference slopes: what is loaded, in use and proposed, and the orders about it.

import { clock, make, milliseconds, nanometres, number, present, put } from "./words.js";
import { usable } from "./orders.js";

const KINDS = {
  zernike: "Zernike coefficients from Noll 1 on (fixed on the pupil)",
  modes: "modes of the basis from mode 0 on (they move with the mirror)",
  map: "square map over the pupil",
  slopes: "slopes measured at optical gain 1",
};
const METRES = { nm: 1e-9, um: 1e-6, m: 1 };

export class References {
  #service;
  #orders;

  constructor(service, orders, root) {
    this.#service = service;
    this.#orders = orders;
    this.root = root;
    orders.learn(REFERENCE_ORDERS);
    const [button, file] = [root.querySelector("[name=load]"), root.querySelector("input[type=file]")];
    button.addEventListener("click", () => file.click());
    file.addEventListener("change", () => this.#load(file));
    for (const name of ["state", "lost"]) service.addEventListener(name, () => this.#show());
    this.#show();
  }

  async #load(file) {
    const [chosen] = file.files;
    file.value = ""; // the same file may be chosen again
    if (!chosen) return;
    try {
      const { rmsOf, shapeOf } = await import("./shapes.js");
      const content = { ...shapeOf(chosen.name, await chosen.arrayBuffer()), source: chosen.name };
      this.#orders.open("load-shape", { content, rms: (kind) => rmsOf(kind, content.values) });
    } catch (error) {
      this.#orders.say(`${chosen.name}: ${error.message}; the references in use stay`);
    }
  }

  #show() {
    const { state, fresh, now } = this.#service;
    const held = state?.references;
    this.root.classList.toggle("old", !fresh);
    usable(this.root.querySelector("[name=load]"), this.#orders.whyNot("load-shape"));
    const { shape, used, newest, verified, waiting, unsupported, misapplied } = held ?? {};
    const proposed = newest?.state === "proposed" ? newest : null;
    this.root.querySelector(".decide").hidden = !proposed;
    const lines = {
      shape: shape ? `${shape.source || shape.id}, ${shape.kind}, fixed to the ${shape.frame}; loaded ${since(shape.loaded_ns_utc, now)}${shape.by && ` by ${shape.by}`}` : "none: the RTC's own references",
      used: used ? [about(used), `since ${since(used.applied_ns_utc, now)}`, used.by && `sent by ${used.by}`, verified ? "read back" : "not read back yet", measured(used)].filter(Boolean).join(", ") : "none of the service",
      newest: newest && newest.id !== used?.id ? `${newest.id} ${newest.state}: ${about(newest)}${newest.reason && `; ${newest.reason}`}` : "",
      note: [misapplied, unsupported && `the RTC cannot take references (${unsupported}): file with pyrcal export references candidate, or topic references of the link`, shape && waiting].filter(Boolean).join("; "),
    };
    for (const [name, text] of Object.entries(lines)) {
      const row = this.root.querySelector(`.${name}`);
      put(row, text);
      row.hidden = row.previousElementSibling.hidden = !text;
    }
  }
}

function since(ns, now) {
  const ms = milliseconds(ns);
  return ms ? `${clock(ms)} UTC${now - ms > 86_400_000 ? " or a day before" : ""}` : "a time not known";
}

function about({ rms_m: rms, gain }) {
  return present(gain) ? `${nanometres(rms)} RMS, scaled with the optical gain ${number(gain, 2)}` : "the RTC's own references";
}

// What the mirror holds of the change, by the mean of the commands.
function measured({ held_ratio: ratio, held_sigma: sigma }) {
  return present(ratio) ? `the mirror has moved by ${number(100 * ratio, 0)} ± ${number(100 * sigma, 0)} % of it` : "";
}

function newestOf(orders) {
  const { newest } = orders.state.references;
  if (newest?.state !== "proposed") throw new Error("no references are proposed");
  return `v1/references/${encodeURIComponent(newest.id)}`;
}

function factsOf(record, used) {
  return [
    `${record.id}: ${about(record)}.`,
    record.unexplained_ratio > 0.01 && `No controlled mode explains ${number(100 * record.unexplained_ratio, 0)} % of the shape: that part is not held.`,
    used ? `In use: ${used.id}, ${about(used)}.` : "In use: the RTC's own references.",
  ];
}

export const REFERENCE_ORDERS = {
  "load-shape": {
    title: "Load a shape",
    permitted: "load_shape",
    make(orders, { content: file, rms }) {
      const { mode } = orders.state;
      return {
        title: `Load ${file.source}`,
        fields: [
          { name: "kind", label: "Numbers", options: [["", "choose"], ...Object.entries(KINDS)], value: file.kind ?? "", needed: true },
          { name: "unit", label: "Unit", options: [["", "choose; none for slopes"], ...Object.keys(METRES).map((unit) => [unit, unit])], value: file.unit ?? "" },
        ],
        facts: ({ kind, unit }) => [
          `${file.values.length} numbers${kind && kind !== "slopes" && unit ? `, ${nanometres(METRES[unit] * rms(kind))} RMS` : ""}. It is what the mirror is to add: the opposite of the aberration.`,
          mode === "auto" ? "Mode is auto: references for it are sent at once, if the loop survives the worst seeing expected with them." : `Mode is ${mode}: references for it wait for an approval.`,
          "Others follow the optical gain and the registration. A shape that is too large is refused, and the references in use stay.",
        ],
        button: "Load",
        method: "POST",
        path: "v1/references",
        body: ({ kind, unit }) => ({ ...file, kind, frame: kind === "modes" ? "mirror" : "instrument", unit: kind === "slopes" ? null : unit ?? null }),
      };
    },
  },
  "approve-references": {
    title: "Approve references",
    permitted: "approve_references",
    about: newestOf,
    make: (orders, _, record) => ({
      title: `Approve ${record.id}`,
      facts: [...factsOf(record, orders.state.references.used), "The RTC goes there by a ramp; a window of telemetry ends."],
      button: "Approve and send",
      method: "POST",
      path: `v1/references/${encodeURIComponent(record.id)}/approve`,
    }),
  },
  "reject-references": {
    title: "Reject references",
    permitted: "reject_references",
    about: newestOf,
    make: (orders, _, record) => ({
      title: `Reject ${record.id}`,
      facts: [...factsOf(record, orders.state.references.used), "No others are made before a shape is loaded."],
      button: "Reject",
      asked: true,
      method: "POST",
      path: `v1/references/${encodeURIComponent(record.id)}/reject`,
    }),
  },
  "rollback-references": {
    title: "Roll back references",
    permitted: "roll_back_references",
    make: (orders) => ({
      title: "Roll back references",
      facts: [
        `In use: ${orders.state.references.used ? about(orders.state.references.used) : "the RTC's own references"}.`,
        "Those in use before are sent again; without any the RTC returns to its own.",
        "No others are made before a shape is loaded.",
      ],
      button: "Roll back",
      asked: true,
      method: "POST",
      path: "v1/references/rollback",
    }),
  },
  "clear-shape": {
    title: "Hold no shape",
    permitted: "clear_shape",
    make: () => ({
      title: "Hold no shape any more",
      facts: ["The RTC returns to its own references by a ramp: the science image gets its aberrations back."],
      button: "Return to the RTC's own references",
      asked: true,
      method: "DELETE",
      path: "v1/references",
    }),
  },
};
