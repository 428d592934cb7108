// Numbers, times and states as operators say them. What is absent is a dash, never 0.

export const DASH = "–";

export const PARAMETERS = [
  { key: "shift_x_subap", label: "shift x", unit: "% of a subaperture", short: "%", scale: 100, zero: 0 },
  { key: "shift_y_subap", label: "shift y", unit: "% of a subaperture", short: "%", scale: 100, zero: 0 },
  { key: "rotation_deg", label: "rotation", unit: "degrees", short: "deg", scale: 1, zero: 0 },
  { key: "magnification", label: "magnification", unit: "ratio", short: "", scale: 1, zero: 1 },
];

export function present(value) {
  return typeof value === "number" && Number.isFinite(value);
}

export function number(value, digits = 2, unit = "") {
  return present(value) ? `${fixed(value, digits)}${unit && ` ${unit}`}` : DASH;
}

// What rounds to nothing has no sign.
export function fixed(value, digits) {
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text;
}

export function nanometres(metres) {
  if (!present(metres)) return DASH;
  const nm = metres * 1e9;
  return `${fixed(nm, Math.abs(nm) < 20 ? 1 : 0)} nm`;
}

// A value rounded to its 1 sigma, which is shown with two digits where it begins with 1.
export function rounded(value, sigma, parameter) {
  if (!present(value)) return { value: DASH, sigma: DASH };
  const scaled = value * parameter.scale;
  const signed = (digits) => {
    const text = fixed(scaled, digits);
    return `${parameter.zero === 0 && !text.startsWith("-") && Number(text) !== 0 ? "+" : ""}${text}`;
  };
  if (!present(sigma) || sigma <= 0) return { value: signed(3), sigma: DASH };
  const error = sigma * parameter.scale;
  const first = error / 10 ** Math.floor(Math.log10(error));
  const digits = Math.min(6, Math.max(0, -Math.floor(Math.log10(error)) + (first < 1.95 ? 1 : 0)));
  return { value: signed(digits), sigma: error.toFixed(digits) };
}

export function clock(ms) {
  return new Date(ms).toISOString().slice(11, 19);
}

export function day(ms) {
  return new Date(ms).toISOString().slice(0, 10);
}

// Two units, or coarse, one: 1 min 17 s, 1 min.
export function span(seconds, coarse = false) {
  if (!present(seconds)) return DASH;
  const s = Math.max(0, seconds);
  if (coarse && s >= 60) return span(s - (s < 3600 ? s % 60 : s < 86400 ? s % 3600 : s % 86400)).replace(/ 0 .*/, "");
  if (s < 10) return `${s.toFixed(1)} s`;
  if (s < 60) return `${Math.round(s)} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${Math.round(s % 60)} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  return `${Math.floor(s / 86400)} d ${Math.floor((s % 86400) / 3600)} h`;
}

export function ago(ms, now, coarse = false) {
  return present(ms) && ms > 0 ? `${span((now - ms) / 1000, coarse)} ago` : DASH;
}

export function milliseconds(ns) {
  return present(ns) ? ns / 1e6 : null;
}

// Each symbol means one thing, wherever it stands.
export const SYMBOLS = {
  critical: "■", serious: "◆", warning: "▲", info: "·", // how much an alarm or a line of the log matters
  over: "◇", muted: "⊘", none: "○", // an alarm that nobody has seen, one that is muted; nothing of the kind
  good: "●", busy: "◐", lost: "✕", // all is well; under way; not known
  swap: "⇄", jump: "↯", alarm: "!", note: "✎", // on a time axis
};

export const SEVERITIES = ["warning", "serious", "critical"];

// The colour of what matters so much.
export function toneOf(severity) {
  return severity === "critical" ? "bad" : severity ? "warn" : "";
}

// What the service is in and does. Only a loop that is closed and followed is well.
export function operation(state) {
  const { service_state: word, current_operation, because } = state.operating;
  const [name, symbol, tone] = OPERATIONS[word];
  const open = state.rtc?.loop === "open";
  const does = state.stopped_because ? "STOPPED" : current_operation !== "Idle" ? current_operation.toUpperCase()
    : open ? "LOOP OPEN" : state.rtc && !state.registration ? "α NOT KNOWN" : "";
  const shown = { word: does ? `${name} · ${does}` : name, symbol, tone, why: because };
  if (word !== "Operational" && word !== "Ready") return shown;
  if (state.stopped_because) return { ...shown, symbol: SYMBOLS.warning, tone: "warn" };
  const follows = word === "Operational" && !open && state.registration && current_operation !== "Idle";
  return follows ? shown : { ...shown, symbol: word === "Ready" ? SYMBOLS.none : SYMBOLS.busy, tone: "busy" };
}

const OPERATIONS = {
  Operational: ["OPERATIONAL", SYMBOLS.good, "good"],
  Ready: ["READY", SYMBOLS.none, "busy"],
  Degraded: ["DEGRADED", SYMBOLS.serious, "warn"],
  NotReady: ["NOT READY", SYMBOLS.lost, "bad"],
  Error: ["ERROR", SYMBOLS.critical, "bad"],
};

export const MODES = {
  auto: "the service computes matrices and sends those that pass the stability check",
  propose: "the service computes matrices, and an operator approves each one",
  hold: "the service only measures; nothing is computed or sent without an order",
};

// What the gate found, as a line.
export function verdict(gate) {
  if (!gate) return "not checked";
  const radius = `${number(gate.worst_pole_radius, 3)} of ${number(gate.bound, 2)}`;
  return gate.accepted ? `stable, ${radius}` : `REFUSED, ${radius}: ${gate.reason}`;
}

export function registrationOf(four, sigma) {
  if (!four) return "an unknown registration";
  return PARAMETERS.map((p) => {
    const { value, sigma: error } = rounded(four[p.key], sigma?.[p.key], p);
    return `${p.label} ${value}${error === DASH ? "" : ` ± ${error}`}${p.short && ` ${p.short}`}`;
  }).join(", ");
}

// The same in a line short enough for a table.
export function shortly(four, sigma) {
  if (!four) return "unknown";
  const [x, y, rotation, magnification] = PARAMETERS.map((p) => rounded(four[p.key], sigma?.[p.key], p).value);
  return `${x}, ${y} %, ${rotation} deg, ${magnification}`;
}

// Text into an element only where it differs: screen readers and layout are left in peace.
// Whether every word of a search is in one of these texts.
export function holds(search, ...texts) {
  const text = texts.join(" ").toLowerCase();
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function make(tag, { className = "", text = "", ...rest } = {}, ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text) element.textContent = text;
  for (const [name, value] of Object.entries(rest)) element.setAttribute(name.replaceAll("_", "-"), value);
  element.append(...children);
  return element;
}

// A table for each list that a page names the columns of, in a frame that scrolls and the keyboard reaches.
export function lay(page) {
  for (const frame of page.querySelectorAll("[data-columns]")) {
    const heads = frame.dataset.columns.split("|").map((text) => make("th", { scope: "col", text }));
    frame.tabIndex = 0;
    frame.setAttribute("role", "region");
    frame.append(make("table", {}, make("thead", {}, make("tr", {}, ...heads)), make("tbody")));
  }
}
