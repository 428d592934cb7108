// What charts over time have in common: ticks, axes, marks, and where nothing was there to be drawn.

import { colour } from "./scheme.js";
import { SYMBOLS, clock, fixed } from "./words.js";

const MARKS = new Set(["swap", "jump", "alarm", "note"]);
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400];
const QUIET_S = 37; // between two samples of the service's at the most: two of them may be late

// Multiples of a step of 1, 2 or 5: at least two of them, and as many more as there is room for.
export function ticks(low, high, most) {
  const step = stepOf(low, high, most, (k) => [1, 2, 5][((k % 3) + 3) % 3] * 10 ** Math.floor(k / 3), -24);
  return multiples(low, high, step);
}

function timeTicks(from, to, most) {
  return multiples(from, to, stepOf(from, to, most, (k) => STEPS_S[k] ?? 86_400 * (k - STEPS_S.length + 2), 0));
}

// The smallest step of which there are no more than `most`, or the largest of which there are two.
function stepOf(low, high, most, steps, first) {
  const count = (step) => Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1;
  let k = first;
  while (count(steps(k)) > most && k < 200) k += 1;
  while (count(steps(k)) < 2 && k > first) k -= 1;
  return steps(k);
}

function multiples(low, high, step) {
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

// As many digits as every multiple of the step needs.
export function decimals(values) {
  for (let n = 0; n < 6; n++) if (values.every((y) => Math.abs(y * 10 ** n - Math.round(y * 10 ** n)) < 1e-6)) return n;
  return 6;
}

// Time below, shown in words only where `labelled`, and numbers at the left of a chart.
export function axes({ labelled, span, known = () => true }) {
  const look = { stroke: () => colour("quiet"), grid: { stroke: () => colour("line"), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
  return [
    { ...look, size: labelled ? 22 : 4,
      splits: (u, of, low, high) => timeTicks(low, high, Math.max(2, Math.floor(u.width / 90))),
      values: (u, at) => at.map((t) => (labelled ? timeOf(t, span(), at) : "")) },
    { ...look, size: 54,
      splits: (u, of, low, high) => ticks(low, high, Math.max(2, Math.floor(u.height / 26))),
      // an axis of nothing has no numbers
      values: (u, at) => at.map((y) => (known(u) ? fixed(y, decimals(at)) : "")) },
  ];
}

function timeOf(t, span, at) {
  const step = at.length > 1 ? at[1] - at[0] : span;
  if (step < 1) return new Date(t * 1000).toISOString().slice(11, 21);
  return clock(t * 1000).slice(0, step < 60 ? 8 : 5);
}

// Lines at marks through a chart; `named`: with their shapes on top.
export function drawMarks(u, marks, named) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.strokeStyle = colour("quiet");
  ctx.fillStyle = colour("text");
  ctx.textAlign = "center";
  ctx.font = `${11 * devicePixelRatio}px system-ui`;
  ctx.setLineDash([2 * devicePixelRatio, 3 * devicePixelRatio]);
  const taken = {}; // shapes of a kind that would lie on one another are drawn once, a jump never lost behind a swap
  const lines = {}; // so are lines: a hundred alarms must not hide what is drawn behind them
  for (const mark of marks.filter((one) => MARKS.has(one.kind))) {
    const x = u.valToPos(mark.t, "x", true);
    if (x < bbox.left || x > bbox.left + bbox.width) continue;
    if (x - (lines[mark.kind] ?? -Infinity) > 4 * devicePixelRatio) {
      lines[mark.kind] = x;
      ctx.globalAlpha = mark.kind === "alarm" ? 0.25 : 0.5;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      ctx.globalAlpha = 1;
    }
    if (!named || x - (taken[mark.kind] ?? -Infinity) < 12 * devicePixelRatio) continue;
    const row = Object.entries(taken).filter(([kind, at]) => kind !== mark.kind && Math.abs(x - at) < 12 * devicePixelRatio).length;
    taken[mark.kind] = x;
    ctx.fillText(SYMBOLS[mark.kind], x, bbox.top + (10 + 11 * row) * devicePixelRatio);
  }
  ctx.restore();
}

// By how much the RTC's clock, which dates telemetry, is behind the service's, seconds; small: by no more than it takes.
export function behind(samples, late = 5) {
  const apart = samples.filter((s) => s.telemetry_ns_utc).map((s) => (s.t_ns_utc - s.telemetry_ns_utc) / 1e9).sort((a, b) => a - b);
  const middle = apart[apart.length >> 1] ?? 0;
  return Math.abs(middle) > late ? middle : 0;
}

// Whether telemetry stopped between two times that are drawn: no sample of the service's has seen any, or there was no service.
// Where it has kept no samples, of before it did, what is longer than `old` is no pause between two measurements.
export class Presence {
  #first;
  #without; // times at which it stopped, seconds, rising
  #quiet;

  constructor(samples, starts, interval, old) {
    this.#first = samples.length ? samples[0].t_ns_utc / 1e9 : Infinity;
    const none = samples.filter((s) => !s.telemetry_ns_utc).map((s) => s.t_ns_utc / 1e9);
    this.#without = [...none, ...starts].sort((a, b) => a - b);
    this.#quiet = Math.max(QUIET_S, 2.5 * interval);
    this.old = old;
  }

  // When it had stopped between these two, null: it had not.
  stopped(a, b) {
    if (b - a > (a >= this.#first - this.#quiet ? this.#quiet : this.old)) return (a + b) / 2;
    let [low, high] = [0, this.#without.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.#without[middle] > a) high = middle;
      else low = middle + 1;
    }
    return this.#without[low] < b ? this.#without[low] : null;
  }
}
