// What is ordered from History: an older reconstructor again, a new one, a note.

import { clock, day, registrationOf, verdict } from "./words.js";

function needed(so, otherwise) {
  if (!so) throw new Error(otherwise);
}

export const HISTORY_ORDERS = {
  publish: {
    title: "Publish again",
    permitted: "publish",
    about(orders, id) {
      needed(id, "no reconstructor is chosen");
      return `v1/reconstructors/${encodeURIComponent(id)}`;
    },
    make(orders, id, record) {
      const { inUse, state } = orders;
      return {
        title: `Publish ${record.id} again`,
        facts: [
          `${record.id}, ${record.n_modes} modes, is sent again under a new id${inUse ? ` in place of ${inUse.id}, ${inUse.n_modes} modes` : ""}.`,
          `Computed for ${registrationOf(record.alpha, record.sigma)}.`,
          `Last stability check: ${verdict(record.gate)}. It is checked again, and not sent if it would be unstable.`,
          state.mode === "hold" ? "Mode stays hold." : `Mode becomes hold (it is ${state.mode}), so that the service does not undo it.`,
        ],
        button: "Publish again",
        asked: true,
        method: "POST",
        path: `v1/reconstructors/${encodeURIComponent(record.id)}/publish`,
      };
    },
  },
  refit: {
    title: "Refit",
    permitted: "refit",
    make(orders) {
      const { rtc, registration, mode } = orders.state;
      return {
        title: "Compute a reconstructor for the present α",
        fields: [{ name: "n_modes", label: "Modes", min: 1, max: rtc.n_modes, placeholder: `as many as now, ${rtc.n_controlled}` }],
        facts: [
          `A reconstructor is computed and checked for ${registrationOf(registration.alpha, registration.sigma)}.`,
          mode === "auto" ? "Mode is auto: it is sent if it passes the stability check." : `Mode is ${mode}: it is proposed, and sent after approval.`,
        ],
        button: "Refit",
        method: "POST",
        path: "v1/refit",
      };
    },
  },
  note: {
    title: "Note",
    make(orders, at) {
      return {
        title: "Add a note",
        fields: [
          { name: "note", label: "Note", type: "text", maxlength: 2000, needed: true },
          { name: "at", label: "Time, UTC", type: "text", pattern: "[0-9]{4}-[0-9]{2}-[0-9]{2} [0-9]{2}:[0-9]{2}:[0-9]{2}", value: `${day(at)} ${clock(at)}`, needed: true },
        ],
        facts: ["It is stored in the history of that time and in the audit trail, and cannot be changed."],
        button: "Save the note",
        method: "POST",
        path: "v1/annotations",
        body: ({ note, at: time }) => ({ note, t_ns_utc: Date.parse(`${time.replace(" ", "T")}Z`) * 1e6 }),
      };
    },
  },
};
