// The four parameters over time: four charts on one time axis, each with its band, tolerance and marks.

/* global uPlot */
import { PARAMETERS, DASH, clock, day, lay, make, present, put, rounded } from "./words.js";
import { colour } from "./scheme.js";

const GAP_S = 120; // longer than any pause between two sittings
const SHAPES = { swap: "▲", jump: "◆", alarm: "■" };
const KINDS = {
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
  tell(four, sigma) {
    for (const row of this.rows) {
      const shown = rounded(four?.[row.parameter.key], sigma?.[row.parameter.key], row.parameter);
      put(row.value, `${shown.value}${four && row.parameter.short ? ` ${row.parameter.short}` : ""}`);
      put(row.sigma, four ? `± ${shown.sigma}` : "");
    }
  }

  // entries of the history, marks, from and to in seconds; tolerance of a parameter as [low, high];
  // ahead: by how much to draw telemetry later, seconds; last: what is known at the end, or null.
  show({ entries, marks, from, to, tolerance = () => [null, null], ahead = 0, last = null }) {
    this.#shown = { entries, marks, from, to, tolerance, ahead, last };
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
    const { entries, from, to, tolerance, ahead, last } = this.#shown;
    const { key, scale } = parameter;
    const columns = [[], [], [], [], [], [], []];
    const gap = Math.max(GAP_S, (to - from) / 20);
    const reach = tolerance(parameter);
    const add = (t, value, sigma, measured) => {
      const before = columns[0].at(-1);
      // no line is drawn across a time of which nothing is known
      if (t - before > gap && present(value)) add((t + before) / 2, null, null, null);
      const known = present(value) && present(sigma);
      const numbers = [known ? (value - 3 * sigma) * scale : null, known ? (value + 3 * sigma) * scale : null,
        present(value) ? value * scale : null, present(measured) ? measured * scale : null, ...reach];
      [t, ...numbers].forEach((x, column) => columns[column].push(x));
    };
    for (const e of entries)
      add(e.t_ns_utc / 1e9 + ahead, e.filtered[key], e.filtered_sigma[key], e.source === "passive" ? null : e.measured[key]);
    if (last && !(columns[0].at(-1) >= to)) add(to, last.alpha[key], last.sigma[key], null);
    return columns;
  }

  #chart({ parameter, plot }, k, data) {
    const last = k === PARAMETERS.length - 1;
    const dashed = { stroke: () => colour("tolerance"), dash: [6, 4], width: 1, points: { show: false } };
    const axis = { stroke: () => colour("quiet"), grid: { stroke: () => colour("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    const options = {
      width: Math.max(plot.clientWidth, 120),
      height: this.#height(plot),
      cursor: { sync: { key: this.root.id || "registration" }, drag: { x: Boolean(this.chosen), y: false, setScale: false }, y: false },
      legend: { show: false },
      tzDate: (t) => uPlot.tzDate(new Date(t * 1000), "UTC"),
      scales: { x: { time: true }, y: { range: (u, low, high) => visible(low, high, parameter) } },
      axes: [
        { ...axis, size: last ? 22 : 4, space: 90,
          values: last ? (u, ticks) => ticks.map((t) => clock(t * 1000).slice(0, this.#shown.to - this.#shown.from < 1200 ? 8 : 5)) : () => [] },
        { ...axis, size: 54, space: 22,
          // an axis of nothing has no numbers
          values: (u, ticks, of, space, step) => ticks.map((y) => (u.data[3].some(present) ? y.toFixed(decimals(step)) : "")) },
      ],
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
      hooks: { draw: [(u) => this.#drawMarks(u, k === 0)], setCursor: [(u) => this.#hover(u, k)], setSelect: [(u) => this.#drawnOver(u)] },
    };
    return new uPlot(options, data, plot);
  }

  #drawMarks(u, named) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = colour("quiet");
    ctx.fillStyle = colour("text");
    ctx.textAlign = "center";
    ctx.font = `${11 * devicePixelRatio}px system-ui`;
    let shapeX = -Infinity; // shapes that would lie on one another are drawn once
    for (const mark of this.#shown.marks) {
      const x = u.valToPos(mark.t, "x", true);
      if (x < bbox.left || x > bbox.left + bbox.width) continue;
      ctx.globalAlpha = 0.45;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      ctx.globalAlpha = 1;
      if (!named || x - shapeX < 12 * devicePixelRatio) continue;
      shapeX = x;
      ctx.fillText(SHAPES[mark.kind], x, bbox.top + 10 * devicePixelRatio);
    }
    ctx.restore();
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
      make("td", { text: entry.entered ? entry.source : `${entry.source}, not believed` }));
  });
}

// As many as every multiple of the step needs.
function decimals(step) {
  for (let n = 0; n < 6; n++) if (Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < 1e-6) return n;
  return 6;
}

// The range of an axis: never so narrow that noise fills it.
function visible(low, high, { zero, scale }) {
  if (!present(low) || !present(high)) return [zero * scale - 1, zero * scale + 1];
  const least = scale === 100 ? 2 : zero === 1 ? 0.001 : 0.02;
  const middle = (low + high) / 2;
  const half = Math.max((high - low) * 0.55, least);
  return [middle - half, middle + half];
}
