// The four parameters over time: four charts on one time axis, each with its band, tolerance and marks.

/* global uPlot */
import { Presence, axes, drawMarks } from "./axes.js";
import { colour } from "./scheme.js";
import { PARAMETERS, DASH, clock, day, lay, make, present, put, rounded } from "./words.js";

const GAP_S = 120; // longer than any pause between two sittings, where no sample says more
const KINDS = {
  "reconstructor.adopted": "swap",
  "service.ready": "start",
  "reconstructor.applied": "swap",
  "registration.jump": "jump",
  "registration.passive-jump": "jump",
};

// What of a line of the log is marked on the time axis; null: nothing.
export function markOf(line) {
  const kind = KINDS[line.name] ?? (line.level === "alarm" ? "alarm" : null);
  return kind && { t: line.t_ns_utc / 1e9, kind };
}

export class Charts {
  #charts = [];
  #shown = null; // what is drawn now
  #numbers; // the newest of it as a table

  // chosen: told the two ends, seconds, of what was drawn over in a chart.
  constructor(root, chosen = null) {
    this.root = root;
    this.chosen = chosen;
    this.rows = PARAMETERS.map((parameter) => this.#row(parameter));
    const columns = ["UTC", ...PARAMETERS.map((p) => `${p.label}${p.short && `, ${p.short}`}`), "from"].join("|");
    this.#numbers = make("details", {}, make("summary", { text: "the last 30 as a table" }),
      make("div", { className: "scrolls", aria_label: "Registration, as a table", data_columns: columns }));
    lay(this.#numbers);
    this.#numbers.addEventListener("toggle", () => this.#list());
    root.parentElement.append(this.#numbers);
    new ResizeObserver(() => this.#resize()).observe(root);
  }

  #row(parameter) {
    const value = make("span", { className: "value", text: DASH });
    const sigma = make("span", { className: "sigma" });
    const plot = make("div", { className: "plot" });
    const label = make("div", { className: "reading" },
      make("span", { className: "label", text: parameter.label }), value, sigma);
    this.root.append(make("div", { className: "chart" }, label, plot));
    return { parameter, value, sigma, plot };
  }

  // The numbers beside the charts: of now, or of where the cursor is.
  tell(four, sigma, tracking) {
    for (const row of this.rows) {
      const shown = rounded(four?.[row.parameter.key], sigma?.[row.parameter.key], row.parameter);
      put(row.value, `${shown.value}${four && row.parameter.short ? ` ${row.parameter.short}` : ""}`);
      const changes = tracking ? ` (changes ±\u00a0${rounded(four?.[row.parameter.key], tracking[row.parameter.key], row.parameter).sigma})` : "";
      put(row.sigma, four ? `± ${shown.sigma}${changes}` : "");
    }
  }

  // entries of the history, samples of the trends, marks, from and to in seconds; tolerance of a parameter as [low, high];
  // ahead: by how much to draw telemetry later, seconds; last: what is known at the end, or null.
  show(asked) {
    const { entries, samples = [], interval = 0, marks, from, to, ahead = 0 } = asked;
    const starts = marks.filter((mark) => mark.kind === "start").map((mark) => mark.t);
    const presence = new Presence(samples, starts, interval, Math.max(GAP_S, (to - from) / 20));
    this.#shown = { tolerance: () => [null, null], last: null, ...asked, points: pointsOf(entries, samples, ahead), presence };
    this.#list();
    if (document.hidden || !this.root.clientWidth) return;
    this.rows.forEach((row, k) => {
      const data = this.#data(row.parameter);
      this.#charts[k] ??= this.#chart(row, k, data);
      const chart = this.#charts[k];
      chart.batch(() => {
        chart.setData(data, false);
        chart.setScale("x", { min: from, max: to });
      });
    });
  }

  #list() {
    if (this.#shown && this.#numbers.open)
      this.#numbers.querySelector("tbody").replaceChildren(...tableOf(this.#shown.entries));
  }

  // x, lower and upper edge of the band, the estimate, single measurements, tolerance.
  #data(parameter) {
    const { points, presence, to, tolerance, last } = this.#shown;
    const { key, scale } = parameter;
    const columns = [[], [], [], [], [], [], []];
    const reach = tolerance(parameter);
    const add = (t, value, sigma, measured) => {
      const before = columns[0].at(-1);
      // no line is drawn across a time of which nothing is known
      const stopped = before === undefined ? null : presence.stopped(before, t);
      if (stopped !== null && present(value)) add(Math.min(stopped, t), null, null, null);
      const known = present(value) && present(sigma);
      const numbers = [known ? (value - 3 * sigma) * scale : null, known ? (value + 3 * sigma) * scale : null,
        present(value) ? value * scale : null, present(measured) ? measured * scale : null, ...reach];
      [t, ...numbers].forEach((x, column) => columns[column].push(x));
    };
    for (const p of points) add(p.t, p.alpha?.[key], p.sigma?.[key], p.measured?.[key]);
    if (last && !(columns[0].at(-1) >= to)) add(to, last.alpha[key], last.sigma[key], null);
    return columns;
  }

  #chart({ parameter, plot }, k, data) {
    const last = k === PARAMETERS.length - 1;
    const dashed = { stroke: () => colour("tolerance"), dash: [6, 4], width: 1, points: { show: false } };
    const options = {
      width: Math.max(plot.clientWidth, 120),
      height: this.#height(plot),
      cursor: { sync: { key: this.root.id || "registration" }, drag: { x: Boolean(this.chosen), y: false, setScale: false }, y: false },
      legend: { show: false },
      tzDate: (t) => uPlot.tzDate(new Date(t * 1000), "UTC"),
      scales: { x: { time: true }, y: { range: (u) => visible(...reachOf(u.data), parameter) } },
      axes: axes({ labelled: last, span: () => this.#shown.to - this.#shown.from, known: (u) => u.data[3].some(present) }),
      series: [
        {},
        { stroke: "transparent", points: { show: false } },
        { stroke: "transparent", points: { show: false } },
        { stroke: () => colour("accent"), width: 1.5, points: { show: false } },
        { stroke: "transparent", points: { show: true, size: 3, fill: () => colour("measured"), stroke: "transparent" } },
        dashed,
        { ...dashed },
      ],
      bands: [{ series: [2, 1], fill: () => colour("band") }],
      hooks: { draw: [(u) => drawMarks(u, this.#shown.marks, k === 0)], setCursor: [(u) => this.#hover(u, k)], setSelect: [(u) => this.#drawnOver(u)] },
    };
    return new uPlot(options, data, plot);
  }

  #hover(u, k) {
    const { parameter } = this.rows[k];
    const index = u.cursor.idx;
    if (u.cursor.left < 0 || index === null || index === undefined) return;
    const [t, low, high, estimate] = u.data.slice(0, 4).map((column) => column[index]);
    if (!present(estimate)) return;
    const error = (high - low) / 6 / parameter.scale;
    const shown = rounded(estimate / parameter.scale, error, parameter);
    u.root.title = `${parameter.label} ${shown.value} ± ${shown.sigma} ${parameter.unit}, ${clock(t * 1000)} UTC`;
  }

  #drawnOver(u) {
    const { left, width } = u.select;
    if (width > 3) this.chosen(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
    if (width) u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }

  #height(plot) {
    return Math.max(plot.parentElement.clientHeight, 70);
  }

  #resize() {
    if (!this.#shown || !this.root.clientWidth) return;
    if (!this.#charts.length) this.show(this.#shown); // it was out of sight until now
    this.#charts.forEach((chart, k) => {
      const { plot } = this.rows[k];
      chart.setSize({ width: Math.max(plot.clientWidth, 120), height: this.#height(plot) });
    });
  }
}

// The last of the entries as rows of a table, newest first.
function tableOf(entries, most = 30) {
  return entries.slice(-most).reverse().map((entry) => {
    const cells = PARAMETERS.map((p) => {
      const { value, sigma } = rounded(entry.filtered[p.key], entry.filtered_sigma[p.key], p);
      return make("td", { text: `${value} ± ${sigma}` });
    });
    const t = entry.t_ns_utc / 1e6;
    return make("tr", {}, make("th", { scope: "row", text: `${day(t)} ${clock(t)}` }), ...cells,
      make("td", { text: entry.entered ? entry.source : `${entry.source}, rejected` }));
  });
}

// Measurements, and between them what was known as its 1 sigma grew, in order of time.
function pointsOf(entries, samples, ahead) {
  const measured = entries.map((e) => ({ t: e.t_ns_utc / 1e9 + ahead, alpha: e.filtered, sigma: e.filtered_sigma, measured: e.source === "passive" ? null : e.measured }));
  const known = samples.filter((s) => s.alpha && s.telemetry_ns_utc).map((s) => ({ t: s.telemetry_ns_utc / 1e9 + ahead, alpha: s.alpha, sigma: s.sigma, measured: null }));
  return [...measured, ...known].sort((a, b) => a.t - b.t);
}

// From where to where the estimate goes, with nearly all of its band: a moment of which little was known hides nothing else.
function reachOf([, low, high, estimate, , ...tolerance]) {
  const known = estimate.filter(present);
  const halves = low.map((y, k) => (present(y) ? (high[k] - y) / 2 : null)).filter(present).sort((a, b) => a - b);
  const half = halves[Math.floor(0.95 * (halves.length - 1))] ?? 0;
  const ends = tolerance.map((column) => column[0]).filter(present);
  return known.length ? [Math.min(...known.map((y) => y - half), ...ends), Math.max(...known.map((y) => y + half), ...ends)] : [null, null];
}

// The range of an axis: never so narrow that noise fills it.
function visible(low, high, { zero, scale }) {
  if (!present(low) || !present(high)) return [zero * scale - 1, zero * scale + 1];
  const least = scale === 100 ? 2 : zero === 1 ? 0.001 : 0.02;
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.55, least);
  return [middle - half, middle + half];
}
