// Small figures: a few lines over one axis, and a grid of numbers as colours.

/* global uPlot */
import { decimals, ticks } from "./axes.js";
import { colour } from "./scheme.js";
import { fixed, make } from "./words.js";

const STROKES = ["accent", "tolerance", "quiet", "text"];

// Lines over their common x: each {name, values, dots}; "log" for a logarithmic y. Draws again what it has drawn before.
export class Lines {
  #chart = null;
  #root;
  #shape = "";

  constructor(root) {
    this.#root = root;
    new ResizeObserver(() => this.#size()).observe(root);
    document.addEventListener("scheme", () => this.#chart?.redraw());
  }

  // least: half of the narrowest range of y, so that what is the same looks the same.
  // band: the lower and the upper edge of what lies around a line.
  show({ x, lines, band = [], log = false, label = "", least = 0 }) {
    const data = [x, ...lines.map((line) => line.values), ...band];
    const shape = JSON.stringify([lines.map((line) => [line.name, line.dots]), band.length, log]);
    if (shape === this.#shape) return this.#chart.setData(data);
    this.#shape = shape;
    this.#chart?.destroy();
    const axis = { stroke: () => colour("quiet"), grid: { stroke: () => colour("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    this.#chart = new uPlot({
      ...this.#place(),
      cursor: { drag: { x: false, y: false } },
      legend: { show: false },
      scales: { x: { time: false }, y: log ? { distr: 3 } : least ? { range: (u, low, high) => widened(low, high, least) } : {} },
      axes: [
        { ...axis, size: 20, space: 60, splits: (u, of, low, high) => ticks(low, high, Math.max(2, Math.floor(u.width / 60))), values: (u, at) => at.map((x) => fixed(x, decimals(at))) },
        { ...axis, size: 48, space: 24, ...(!log && { splits: (u, of, low, high) => ticks(low, high, Math.max(2, Math.floor(u.height / 28))), values: (u, at) => at.map((y) => fixed(y, decimals(at))) }) },
      ],
      series: [{}, ...lines.map(({ dots }, k) => ({
        stroke: dots ? "transparent" : () => colour(STROKES[k]),
        width: 1.5,
        points: { show: Boolean(dots), size: 6, fill: () => colour(STROKES[k]), stroke: "transparent" },
      })), ...band.map(() => ({ stroke: "transparent", points: { show: false } }))],
      bands: band.length ? [{ series: [lines.length + 2, lines.length + 1], fill: () => colour("band") }] : [],
    }, data, this.#root);
    this.#root.setAttribute("role", "img");
    this.#root.setAttribute("aria-label", `${label}: ${lines.map((line) => line.name).join(", ")}`);
  }

  #place() {
    return { width: Math.max(this.#root.clientWidth, 80), height: Math.max(this.#root.clientHeight, 60) };
  }

  #size() {
    if (this.#root.clientWidth) this.#chart?.setSize(this.#place());
  }
}

function widened(low, high, least) {
  const [middle, half] = [(low + high) / 2, Math.max((high - low) * 0.55, least)];
  return Number.isFinite(middle) ? [middle - half, middle + half] : [-least, least];
}

// What each line is drawn in, in words: colours alone say nothing.
export function keyOf(names) {
  return make("p", { className: "legend" }, ...names.map((name, k) =>
    make("span", {}, make("span", { className: `key line-${STROKES[k]}`, aria_hidden: "true" }), ` ${name}`)));
}

// Rows from the lowest y on, in percent of the end of the scale; null: nothing there. signed: -100 to 100, else 0 to 100.
export function grid(canvas, rows, { signed = false, most = 100, label }) {
  const [width, height] = [rows[0].length, rows.length];
  canvas.width = width;
  canvas.height = height;
  const ctx = canvas.getContext("2d");
  const image = ctx.createImageData(width, height);
  rows.forEach((row, y) => row.forEach((value, x) => {
    if (value === null) return;
    const at = 4 * ((height - 1 - y) * width + x);
    image.data.set([...(signed ? diverging(value / most) : rising(value / most)), 255], at);
  }));
  ctx.putImageData(image, 0, 0);
  canvas.style.aspectRatio = `${width} / ${height}`;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
}

// Blue, grey, orange: told apart by whoever does not see red from green.
function diverging(share) {
  const [end, s] = [share < 0 ? [70, 140, 255] : [255, 150, 40], Math.min(Math.abs(share), 1)];
  return end.map((c) => Math.round(45 + s * (c - 45)));
}

// From dark blue over teal to yellow, ever lighter.
function rising(share) {
  const s = 2 * Math.min(Math.max(share, 0), 1);
  const [from, to, t] = s < 1 ? [[40, 26, 80], [35, 140, 140], s] : [[35, 140, 140], [250, 230, 90], s - 1];
  return from.map((c, k) => Math.round(c + t * (to[k] - c)));
}
