// Small figures beside the reconstructors: singular values, gain per mode, the last slopes. Read only while they are seen.

import { Lines, grid, keyOf } from "./figures.js";
import { clock, make, milliseconds, number, present, put } from "./words.js";

const GAINS_MS = 30_000;
const SLOPES_MS = 1000;

export class Glance {
  #service;
  #orders;
  #singular = new Map(); // by id: it never changes
  #seen = false;
  #asked = { gains: -Infinity, slopes: -Infinity }; // performance.now() of the last look

  constructor(service, orders, root) {
    this.#service = service;
    this.#orders = orders;
    this.root = root;
    this.lines = Object.fromEntries(["singular", "gains"].map((name) => [name, new Lines(root.querySelector(`.${name}`))]));
    new IntersectionObserver(([entry]) => (this.#seen = entry.isIntersecting)).observe(root);
    service.addEventListener("tick", () => this.#onTick());
  }

  #onTick() {
    const { state, fresh } = this.#service;
    this.root.classList.toggle("old", !fresh || !state?.rtc);
    if (!this.#seen || document.hidden || !fresh || !state?.rtc) return;
    this.#showSingular();
    this.#every("gains", GAINS_MS, () => this.#readGains());
    this.#every("slopes", SLOPES_MS, () => this.#readSlopes());
  }

  // One look at a time, and not more often than this; one that fails is tried again then.
  #every(name, wait, read) {
    if (performance.now() - this.#asked[name] < wait) return;
    this.#asked[name] = Infinity;
    read().catch(() => put(this.root.querySelector(`.${name}-said`), "not known")).finally(() => (this.#asked[name] = performance.now()));
  }

  // What is waiting, in use, was before: as far as each is there and has been read.
  #showSingular() {
    const { proposal, inUse, before } = this.#orders;
    const roles = [["in use", inUse], ["waiting", proposal], ["previous", before]].filter(([, record]) => record);
    const ids = new Set(roles.map(([, { id }]) => id));
    for (const id of this.#singular.keys()) if (!ids.has(id)) this.#singular.delete(id);
    for (const id of ids) if (!this.#singular.has(id)) this.#readSingular(id);
    const shown = roles.map(([name, { id }]) => ({ name, values: this.#singular.get(id)?.values })).filter((line) => line.values);
    const nominal = this.#singular.get(roles[0]?.[1].id)?.nominal;
    if (shown.length && nominal) shown.push({ name: "nominal", values: nominal });
    const told = JSON.stringify(roles.map(([name, { id }]) => [name, id, Boolean(this.#singular.get(id))]));
    if (!shown.length || told === this.told) return;
    this.told = told;
    const n = Math.max(...shown.map(({ values }) => values.length));
    const most = Math.max(...shown.map(({ values }) => values[0]));
    const line = (values) => Array.from({ length: n }, (_, k) => (present(values[k]) ? values[k] / most : null));
    this.lines.singular.show({ x: Array.from({ length: n }, (_, k) => k + 1), log: true, label: "Singular values",
      lines: shown.map(({ name, values }) => ({ name, values: line(values) })) });
    this.root.querySelector(".singular-said").replaceChildren(keyOf(shown.map(({ name, values }) => `${name} (${number(values[0] / values.at(-1), 1)})`)));
  }

  async #readSingular(id) {
    this.#singular.set(id, null); // asked for
    try {
      this.#singular.set(id, await this.#service.get(`v1/reconstructors/${encodeURIComponent(id)}/singular-values`, "default"));
    } catch {
      setTimeout(() => this.#singular.delete(id), GAINS_MS); // then it is asked for again
    }
  }

  async #readGains() {
    const table = await this.#service.get("v1/gains");
    const { optical_gain: gains, sigma, measured } = table;
    const at = new Map(measured.map((one) => [one.mode, one.gain]));
    this.lines.gains.show({ x: gains.map((_, mode) => mode), label: "Optical gain of each mode, with 1 sigma",
      lines: [{ name: "expected", values: gains }, { name: "measured", values: gains.map((_, mode) => at.get(mode) ?? null), dots: true }],
      band: [-1, 1].map((side) => gains.map((gain, mode) => gain + side * sigma[mode])) });
    const key = keyOf(measured.length ? ["± 1 σ", "measured"] : ["expected ± 1 σ; none measured"]);
    const conditions = [present(table.magnitude) && `magnitude ${number(table.magnitude, 1)}`, `${number(table.frame_rate_hz, 0)} Hz`].filter(Boolean).join(", ");
    key.append(make("span", { text: conditions }));
    this.root.querySelector(".gains-said").replaceChildren(key);
    put(this.root.querySelector(".gains-time"), table.t_ns_utc ? `, ${clock(milliseconds(table.t_ns_utc))} UTC` : "");
  }

  async #readSlopes() {
    const { rms } = await this.#service.get("v1/slopes");
    const known = rms.flat().filter(present);
    const most = Math.max(...known);
    grid(this.root.querySelector(".slopes"), rms.map((row) => row.map((v) => (present(v) ? (100 * v) / most : null))),
      { label: `Residual slopes, RMS in each subaperture, Sx next to Sy: at most ${number(most, 3)}` });
    put(this.root.querySelector(".slopes-said"), `Sx | Sy, RMS, dark 0 to light ${number(most, 2)}`);
  }
}
