// Two reconstructors side by side: what each was made for, and how differently they answer, mode by mode.

import { Lines, keyOf } from "./figures.js";
import { clock, day, make, milliseconds, number, put, registrationOf, verdict } from "./words.js";

export class Compare {
  #service;
  #reading = 0;

  constructor(service, orders, root) {
    this.#service = service;
    this.root = root;
    [this.first, this.second] = root.querySelectorAll("select");
    this.figures = Object.fromEntries(["rows", "singular"].map((name) => [name, new Lines(root.querySelector(`.${name}`))]));
    for (const choice of [this.first, this.second]) choice.addEventListener("change", () => this.#read());
    root.querySelector("[name=publish]").addEventListener("click", () => orders.open("publish", this.first.value));
    service.addEventListener("reconstructors", () => this.#offer());
    this.#offer();
  }

  // Compare one with what is in use; that with the one that was chosen before.
  choose(id) {
    if (this.second.value === id) this.second.value = this.first.value;
    this.first.value = id;
    this.#read();
  }

  #offer() {
    const every = [...this.#service.reconstructors].reverse();
    const inUse = this.#service.state?.in_use;
    const told = JSON.stringify([every.map((r) => [r.id, r.state]), inUse]);
    if (told === this.told) return;
    this.told = told;
    const chosen = [this.first.value, this.second.value];
    [this.first, this.second].forEach((choice, k) => {
      choice.replaceChildren(...every.map((r) => make("option", { value: r.id, text: `${r.id}, ${r.n_modes} modes, ${r.id === inUse ? "in use" : r.state}` })));
      const usual = k ? inUse : every.find((r) => r.id !== inUse)?.id;
      choice.value = every.some((r) => r.id === chosen[k]) ? chosen[k] : usual ?? "";
    });
    if (every.length) this.#read();
  }

  async #read() {
    const mine = ++this.#reading;
    const ids = [this.first.value, this.second.value];
    const records = ids.map((id) => this.#service.reconstructors.find((r) => r.id === id));
    this.root.querySelector("ul").replaceChildren(...records.filter(Boolean).map((r) => {
      const made = milliseconds(r.created_ns_utc);
      return make("li", { text: `${r.id}: computed ${day(made)} ${clock(made)} UTC for ${registrationOf(r.alpha, r.sigma)}; ${verdict(r.gate)}` });
    }));
    const said = this.root.querySelector(".said");
    if (!ids[0] || !ids[1] || ids[0] === ids[1]) return put(said, "choose two");
    const path = ids.map(encodeURIComponent);
    put(said, "◐ reading");
    const answers = await Promise.all([
      this.#service.get(`v1/reconstructors/${path[0]}/compared-with/${path[1]}`, "no-cache").catch(() => null),
      ...path.map((id) => this.#service.get(`v1/reconstructors/${id}/singular-values`, "default").catch(() => null))]);
    if (mine !== this.#reading) return;
    const [compared, ...singular] = answers;
    put(said, compared ? `they differ by ${number(100 * compared.difference, 1)} % of the second, over ${compared.modes.length} modes` : "the numbers of one of them are no longer archived, or of other slopes");
    this.#draw(compared, singular, ids);
  }

  #draw(compared, singular, ids) {
    if (compared) {
      const lines = [{ name: "gain, first / second", values: compared.gain }, { name: "cosine between rows", values: compared.cosine }];
      this.figures.rows.show({ x: compared.modes, label: "Gain and cosine of each mode", lines, least: 0.02 });
      this.root.querySelector(".rows-said").replaceChildren(keyOf(lines.map((line) => line.name)));
    }
    const there = singular.map((one, k) => one && { name: ids[k], values: one.values }).filter(Boolean);
    if (!there.length) return;
    const n = Math.max(...there.map(({ values }) => values.length));
    const most = Math.max(...there.map(({ values }) => values[0]));
    const lines = there.map(({ name, values }) => ({ name, values: Array.from({ length: n }, (_, k) => (k in values ? values[k] / most : null)) }));
    this.figures.singular.show({ x: Array.from({ length: n }, (_, k) => k + 1), log: true, label: "Singular values relative to the largest", lines });
    this.root.querySelector(".singular-said").replaceChildren(keyOf(lines.map(({ name, values }) => `${name} (${number(values[0] / values.findLast((v) => v !== null), 1)})`)));
  }
}
