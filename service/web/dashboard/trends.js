// How the night went, on the time axis of α: wavefront error, margin, gain, flux, pointing; and α against the pointing.

/* global uPlot */
import { Presence, axes, drawMarks } from "./axes.js";
import { Lines } from "./figures.js";
import { colour } from "./scheme.js";
import { DASH, PARAMETERS, clock, make, nanometres, number, present, put } from "./words.js";

const STROKES = ["accent", "tolerance"];

// Each: what it is, how it is written, its lines of the samples, and what it may not pass.
const ROWS = [
  { label: "wavefront error", unit: "nm", write: (y) => nanometres(y / 1e9), lines: [
    { name: "model", of: (s) => times(s.wavefront_m, 1e9) }, { name: "from the slopes", of: (s) => times(s.residual_m, 1e9) }] },
  { label: "stability", unit: "pole radius relative to its limit", write: (y) => number(y, 3), limit: 1, lines: [{ name: "", of: (s) => s.margin }] },
  { label: "optical gain", unit: "", write: (y) => number(y, 2), lines: [{ name: "", of: (s) => s.optical_gain }] },
  { label: "flux", unit: "", write: (y) => number(y, 1), instead: "magnitude", lines: [{ name: "", of: (s) => s.flux }] },
  { label: "elevation", unit: "deg", write: (y) => number(y, 1, "deg"), lines: [{ name: "", of: (s) => s.elevation_deg }] },
  { label: "azimuth", unit: "deg", write: (y) => number(y, 1, "deg"), lines: [{ name: "", of: (s) => s.azimuth_deg }] },
];

function times(value, scale) {
  return present(value) ? value * scale : null;
}

export class Trends {
  #charts = [];
  #shown = null;

  // chosen: told the two ends, seconds, of what was drawn over in a chart.
  constructor(root, chosen) {
    this.root = root;
    this.chosen = chosen;
    this.rows = ROWS.map((row) => this.#row(row));
    new ResizeObserver(() => this.#shown && this.show(this.#shown)).observe(root);
  }

  #row(row) {
    const value = make("span", { className: "value", text: DASH });
    const plot = make("div", { className: "plot" });
    const keys = row.lines.filter((line) => line.name).map((line, k) =>
      make("span", { className: "key-of" }, make("span", { className: `key line-${STROKES[k]}`, aria_hidden: "true" }), ` ${line.name}`));
    const label = make("div", { className: "reading" }, make("span", { className: "label", text: row.label }), value, ...keys);
    this.root.append(make("div", { className: "chart" }, label, plot));
    return { ...row, value, plot };
  }

  show(asked) {
    this.#shown = asked;
    if (document.hidden || !this.root.clientWidth) return;
    const { samples, interval, marks, from, to } = asked;
    const starts = marks.filter((mark) => mark.kind === "start").map((mark) => mark.t);
    const presence = new Presence(samples.filter((s) => s.telemetry_ns_utc), starts, interval, Infinity);
    this.rows.forEach((row, k) => {
      if (row.instead) this.#choose(row, samples);
      const data = columnsOf(row, samples, presence);
      const last = row.lines.map((_, j) => data[j + 1].findLast(present));
      put(row.value, last.some(present) ? last.filter(present).map(row.write).join(", ") : DASH);
      this.#charts[k] ??= this.#chart(row, k, data);
      const chart = this.#charts[k];
      chart.batch(() => {
        chart.setSize({ width: Math.max(row.plot.clientWidth, 120), height: Math.max(row.plot.parentElement.clientHeight, 50) });
        chart.setData(data, false);
        chart.setScale("x", { min: from, max: to });
      });
    });
  }

  // An RTC without a flux map may tell the star's magnitude.
  #choose(row, samples) {
    const key = samples.some((s) => present(s[row.label])) ? row.label : row.instead;
    row.lines[0].of = (s) => s[key];
    put(row.plot.parentElement.querySelector(".label"), key === row.label ? row.label : `star, ${key}`);
  }

  #chart(row, k, data) {
    const line = (_, j) => ({ stroke: () => colour(STROKES[j]), width: 1.5, points: { show: false } });
    const limit = { stroke: () => colour("tolerance"), dash: [6, 4], width: 1, points: { show: false } };
    return new uPlot({
      width: Math.max(row.plot.clientWidth, 120),
      height: Math.max(row.plot.parentElement.clientHeight, 50),
      cursor: { sync: { key: "past" }, drag: { x: true, y: false, setScale: false }, y: false },
      legend: { show: false },
      scales: { x: { time: true }, y: { range: (u, low, high) => roomy(low, high) } },
      axes: axes({ labelled: k === ROWS.length - 1, span: () => this.#shown.to - this.#shown.from, known: (u) => row.lines.some((_, j) => u.data[j + 1].some(present)) }),
      series: [{}, ...row.lines.map(line), ...(row.limit ? [limit] : [])],
      hooks: {
        draw: [(u) => drawMarks(u, this.#shown.marks, k === 0)],
        setCursor: [(u) => tellAt(u, row)],
        setSelect: [(u) => this.#drawnOver(u)],
      },
    }, data, row.plot);
  }

  #drawnOver(u) {
    const { left, width } = u.select;
    if (width > 3) this.chosen(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
    if (width) u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }
}

function tellAt(u, row) {
  const { idx: k, left } = u.cursor;
  if (left < 0 || k === null || k === undefined) return;
  const values = row.lines.map((line, j) => [line.name, u.data[j + 1][k]]).filter(([, y]) => present(y));
  u.root.title = values.length ? `${row.label} ${values.map(([name, y]) => `${row.write(y)}${name && ` ${name}`}`).join(", ")}${row.unit && row.unit.includes(" ") ? `, ${row.unit}` : ""}, ${clock(u.data[0][k] * 1000)} UTC` : "";
}

// Times, each line, and the limit; no line is drawn across a time without telemetry.
function columnsOf(row, samples, presence) {
  const columns = [[], ...row.lines.map(() => []), ...(row.limit ? [[]] : [])];
  const add = (t, sample) => {
    columns[0].push(t);
    row.lines.forEach((line, j) => columns[j + 1].push((sample && line.of(sample)) ?? null));
    if (row.limit) columns.at(-1).push(row.limit);
  };
  for (const sample of samples) {
    const t = sample.t_ns_utc / 1e9;
    const before = columns[0].at(-1);
    const stopped = before === undefined ? null : presence.stopped(before, t);
    if (stopped !== null) add(stopped, null);
    add(t, sample.telemetry_ns_utc ? sample : null);
  }
  return columns;
}

function roomy(low, high) {
  if (!present(low) || !present(high)) return [0, 1];
  const half = Math.max((high - low) * 0.55, Math.abs(high + low) * 0.01, 1e-3);
  const middle = (low + high) / 2;
  return [middle - half, middle + half];
}

// α against where the telescope looked: flexure is a line there, and a jump two clouds.
export class Against {
  constructor(root) {
    this.root = root;
    this.choice = root.querySelector("select");
    this.said = root.querySelector(".said");
    this.plots = PARAMETERS.map((parameter) => {
      const plot = make("div", { className: "plot" });
      const head = make("figcaption", { text: `${parameter.label}${parameter.short && `, ${parameter.short}`}` });
      root.querySelector(".plots").append(make("figure", {}, head, plot));
      return new Lines(plot);
    });
    this.choice.addEventListener("change", () => this.show(this.samples));
  }

  show(samples) {
    this.samples = samples;
    const key = this.choice.value;
    const seen = samples.filter((s) => s.alpha && s.telemetry_ns_utc && present(s[key])).sort((a, b) => a[key] - b[key]);
    const word = this.choice.selectedOptions[0].text;
    put(this.said, seen.length ? `${seen.length} samples, ${word} ${number(seen[0][key], 1)} to ${number(seen.at(-1)[key], 1)} deg` : `no ${word} was reported in this time`);
    this.root.querySelector(".plots").hidden = !seen.length;
    if (!seen.length) return;
    this.plots.forEach((plot, k) => {
      const { key: name, scale, label } = PARAMETERS[k];
      plot.show({ x: seen.map((s) => s[key]), label: `${label} against ${word}`, lines: [{ name: label, values: seen.map((s) => s.alpha[name] * scale), dots: true }] });
    });
  }
}
