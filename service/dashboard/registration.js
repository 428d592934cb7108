// The registration over time: four charts on one time axis, each with its band, tolerance and marks.

/* global uPlot */
import { PARAMETERS, DASH, ago, clock, day, make, milliseconds, present, put, rounded } from "./words.js";

const RANGES = { 1: 600, 2: 3600, 3: 43_200 }; // seconds: ten minutes, an hour, a night
const POINTS = { 1: 600, 2: 1200, 3: 2000 };
const MOST = 4000; // then the range is read anew, thinned by the service
const EVERY_MS = 5000; // between two looks at what has been measured since
const LATE_MS = 5000; // telemetry takes less than this to be understood: more is another clock
const GAP_S = 120; // longer than any pause between two sittings
const AXIS = "#9aa4af";
const GRID = "#2a3038";
const ACCENT = "#6cb6ff";
const BAND = "rgba(108, 182, 255, 0.18)";
const TOLERANCE = "#c9a24a";
const MEASURED = "rgba(200, 208, 216, 0.45)";
const SHAPES = { swap: "▲", jump: "◆", alarm: "■" };
const MARKS = {
  "reconstructor.applied": "swap",
  "registration.jump": "jump",
  "registration.passive-jump": "jump",
};

export class Registration {
  #service;
  #entries = []; // of the service's history, oldest first
  #marks = [];
  #mirror = null;
  #charts = [];
  #range = 1;
  #reading = false;
  #asked = 0;
  #drawn = 0;

  constructor(service, root) {
    this.#service = service;
    this.root = root;
    this.values = PARAMETERS.map((parameter) => this.#row(parameter));
    for (const button of root.querySelectorAll("[data-range]"))
      button.addEventListener("click", () => this.choose(Number(button.dataset.range)));
    service.addEventListener("state", () => this.#onState());
    service.addEventListener("tick", () => this.#onTick());
    service.addEventListener("log", (event) => this.#mark(event.detail));
    service.addEventListener("reset", () => {
      this.#marks = [];
      this.#begin();
    });
    new ResizeObserver(() => this.#resize()).observe(root.querySelector(".charts"));
    root.querySelector("details").addEventListener("toggle", () => this.#table());
  }

  choose(range) {
    this.#range = range;
    for (const button of this.root.querySelectorAll("[data-range]"))
      button.setAttribute("aria-pressed", String(Number(button.dataset.range) === range));
    this.#begin();
  }

  set mirror(mirror) {
    this.#mirror = mirror;
    this.#draw();
  }

  #row(parameter) {
    const value = make("span", { className: "value", text: DASH });
    const sigma = make("span", { className: "sigma" });
    const plot = make("div", { className: "plot" });
    const label = make("div", { className: "reading" },
      make("span", { className: "label", text: parameter.label }), value, sigma);
    this.root.querySelector(".charts").append(make("div", { className: "chart" }, label, plot));
    return { parameter, value, sigma, plot };
  }

  // Read the range anew: at the start, on another range, after a gap.
  async #begin() {
    this.#entries = [];
    await this.#read();
  }

  // By how much the RTC's clock, which dates telemetry, is behind the service's, milliseconds.
  get #behind() {
    const { state } = this.#service;
    const known = state?.registration;
    const ms = known ? (state.now_ns - known.t_ns_utc) / 1e6 - known.age_s * 1000 : 0;
    return Math.abs(ms) > LATE_MS ? ms : 0;
  }

  async #read() {
    if (this.#reading) return;
    this.#reading = true;
    this.#asked = performance.now();
    const range = this.#range;
    const since = Math.max(0, this.#service.now - RANGES[range] * 1000 - this.#behind);
    const last = this.#entries.at(-1)?.t_ns_utc;
    const query = last ? `after=${last}&limit=2000` : `since=${new Date(since).toISOString()}&points=${POINTS[range]}`;
    try {
      const { entries } = await this.#service.get(`v1/alpha/history?${query}`);
      if (range === this.#range) {
        const newest = this.#entries.at(-1)?.t_ns_utc ?? 0;
        this.#entries.push(...entries.filter((e) => e.t_ns_utc > newest));
        this.#forget(since);
      }
    } catch {
      // the banner tells that the connection is lost; the next state asks again
    } finally {
      this.#reading = false;
      if (range !== this.#range) this.#begin();
    }
    this.#draw();
  }

  #forget(since) {
    const first = this.#entries.findIndex((e) => e.t_ns_utc / 1e6 >= since);
    this.#entries.splice(0, first < 0 ? 0 : first);
    if (this.#entries.length > MOST) this.#entries = [];
  }

  #mark(lines) {
    for (const line of lines) {
      const kind = MARKS[line.name] ?? (line.level === "alarm" ? "alarm" : null);
      const t = line.t_ns_utc / 1e9;
      if (kind && !this.#marks.some((m) => m.t === t && m.kind === kind)) this.#marks.push({ t, kind });
    }
    this.#marks = this.#marks.slice(-MOST);
  }

  #onState() {
    const known = this.#service.state.registration;
    for (const { parameter, value, sigma } of this.values) {
      const shown = rounded(known?.alpha[parameter.key], known?.sigma[parameter.key], parameter);
      put(value, `${shown.value}${known && parameter.short ? ` ${parameter.short}` : ""}`);
      put(sigma, known ? `± ${shown.sigma}` : "");
    }
    const newest = this.#entries.at(-1)?.t_ns_utc ?? 0;
    // the state itself is the last point of every line: what is behind it may come later
    const due = performance.now() - this.#asked > EVERY_MS || !newest;
    if (known && due && known.t_ns_utc > newest + 1000) this.#read();
  }

  #onTick() {
    const { state, now, fresh } = this.#service;
    const known = state?.registration;
    const old = !fresh || (known && known.validity !== "fresh");
    for (const { value } of this.values) value.parentElement.classList.toggle("old", Boolean(old));
    const measured = known && milliseconds(known.t_ns_utc);
    const worth = known ? `${known.validity}, from telemetry of ${ago(measured, now)}` : "not known yet";
    const why = known?.validity_reason ? `: ${known.validity_reason}` : "";
    put(this.root.querySelector(".worth"), state ? worth + why : DASH);
    if (performance.now() - this.#drawn > 1000) this.#draw();
  }

  #draw() {
    if (document.hidden || !this.#service.state) return;
    this.#drawn = performance.now();
    const now = this.#service.now / 1000;
    this.values.forEach((row, k) => {
      const data = this.#data(row.parameter, now);
      this.#charts[k] ??= this.#chart(row, k);
      const chart = this.#charts[k];
      chart.batch(() => {
        chart.setData(data, false);
        chart.setScale("x", { min: now - RANGES[this.#range], max: now });
      });
    });
    this.#summary();
  }

  // x, lower and upper edge of the band, the estimate, single measurements, tolerance.
  #data(parameter, now) {
    const { key, scale } = parameter;
    const columns = [[], [], [], [], [], [], []];
    const gap = Math.max(GAP_S, RANGES[this.#range] / 20);
    const add = (t, value, sigma, measured) => {
      const before = columns[0].at(-1);
      // no line is drawn across a time of which nothing is known
      if (t - before > gap && present(value)) add((t + before) / 2, null, null, null);
      const known = present(value) && present(sigma);
      const numbers = [known ? (value - 3 * sigma) * scale : null, known ? (value + 3 * sigma) * scale : null,
        present(value) ? value * scale : null, present(measured) ? measured * scale : null, ...this.#tolerance(parameter)];
      [t, ...numbers].forEach((x, column) => columns[column].push(x));
    };
    const behind = this.#behind / 1000;
    for (const e of this.#entries)
      add(e.t_ns_utc / 1e9 + behind, e.filtered[key], e.filtered_sigma[key], e.source === "passive" ? null : e.measured[key]);
    const known = this.#service.fresh ? this.#service.state.registration : null;
    const last = columns[0].at(-1);
    if (known && !(last >= now)) add(now, known.alpha[key], known.sigma[key], null);
    return columns;
  }

  // How far α may go from what the matrix in use was made for.
  #tolerance({ key, scale }) {
    const { state, reconstructors } = this.#service;
    const made = reconstructors.find((r) => r.id === state.in_use)?.alpha;
    if (!made || !this.#mirror) return [null, null];
    const reach = this.#mirror.tolerance[key];
    return [(made[key] - reach) * scale, (made[key] + reach) * scale];
  }

  #chart({ parameter, plot }, k) {
    const last = k === PARAMETERS.length - 1;
    const dashed = { stroke: TOLERANCE, dash: [6, 4], width: 1, points: { show: false } };
    const options = {
      width: Math.max(plot.clientWidth, 120),
      height: this.#height(plot),
      cursor: { sync: { key: "registration" }, drag: { x: false, y: false }, y: false },
      legend: { show: false },
      tzDate: (t) => uPlot.tzDate(new Date(t * 1000), "UTC"),
      scales: { x: { time: true }, y: { range: (u, low, high) => visible(low, high, parameter) } },
      axes: [
        { stroke: AXIS, grid: { stroke: GRID, width: 1 }, ticks: { show: false }, size: last ? 22 : 4,
          values: last ? (u, ticks) => ticks.map((t) => clock(t * 1000).slice(0, this.#range === 1 ? 8 : 5)) : () => [],
          space: 90, font: "11px system-ui" },
        { stroke: AXIS, grid: { stroke: GRID, width: 1 }, ticks: { show: false }, size: 54, space: 22, font: "11px system-ui",
          // an axis of nothing has no numbers
          values: (u, ticks, axis, space, step) => ticks.map((y) => (u.data[3].some(present) ? y.toFixed(decimals(step)) : "")) },
      ],
      series: [
        {},
        { stroke: "transparent", points: { show: false } },
        { stroke: "transparent", points: { show: false } },
        { stroke: ACCENT, width: 1.5, points: { show: false } },
        { stroke: "transparent", points: { show: true, size: 3, fill: MEASURED, stroke: "transparent" } },
        dashed,
        { ...dashed },
      ],
      bands: [{ series: [2, 1], fill: BAND }],
      hooks: { draw: [(u) => this.#drawMarks(u, k === 0)], setCursor: [(u) => this.#hover(u, k)] },
    };
    return new uPlot(options, this.#data(parameter, this.#service.now / 1000), plot);
  }

  #drawMarks(u, named) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = AXIS;
    ctx.fillStyle = "#e6e9ed";
    ctx.textAlign = "center";
    ctx.font = `${11 * devicePixelRatio}px system-ui`;
    let shapeX = -Infinity; // shapes that would lie on one another are drawn once
    for (const mark of this.#marks) {
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
    const { parameter } = this.values[k];
    const index = u.cursor.idx;
    if (u.cursor.left < 0 || index === null || index === undefined) return;
    const [t, low, high, estimate] = u.data.slice(0, 4).map((column) => column[index]);
    if (!present(estimate)) return;
    const error = (high - low) / 6 / parameter.scale;
    const shown = rounded(estimate / parameter.scale, error, parameter);
    u.root.title = `${parameter.label} ${shown.value} ± ${shown.sigma} ${parameter.unit}, ${clock(t * 1000)} UTC`;
  }

  #summary() {
    const first = this.#entries[0];
    const span = first ? `${this.#entries.length} measurements since ${clock(first.t_ns_utc / 1e6)} UTC` : "no measurement in this time";
    put(this.root.querySelector(".span"), span);
    if (this.root.querySelector("details").open) this.#table();
  }

  #table() {
    const rows = this.#entries.slice(-30).reverse().map((entry) => {
      const cells = PARAMETERS.map((p) => {
        const { value, sigma } = rounded(entry.filtered[p.key], entry.filtered_sigma[p.key], p);
        return make("td", { text: `${value} ± ${sigma}` });
      });
      const t = entry.t_ns_utc / 1e6;
      return make("tr", {}, make("th", { scope: "row", text: `${day(t)} ${clock(t)}` }), ...cells,
        make("td", { text: entry.entered ? entry.source : `${entry.source}, not believed` }));
    });
    this.root.querySelector("tbody").replaceChildren(...rows);
  }

  #height(plot) {
    return Math.max(plot.parentElement.clientHeight, 70);
  }

  #resize() {
    this.#charts.forEach((chart, k) => {
      const { plot } = this.values[k];
      chart.setSize({ width: Math.max(plot.clientWidth, 120), height: this.#height(plot) });
    });
  }
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
