// Interaction matrices that were measured, fits of them and of files, and what a fit has found.

import { Lines, grid, keyOf } from "./figures.js";
import { parcelOf } from "./parcel.js";
import { DASH, PARAMETERS, ago, clock, day, make, milliseconds, nanometres, number, present, put, rounded, shortly, span } from "./words.js";
import { bar } from "./work.js";

const STAGES = ["reading", "modes", "orientation", "fit", "verdict", "figures"];
const UNFINISHED = new Set(["receiving", "waiting", "running"]);
const UNDER_WAY = new Set(["waiting", "asked", "running", "finishing"]);
const LOOK_MS = 1000; // between two looks while something runs; else only when this page is opened

export class Measurements {
  #service;
  #matrices = [];
  #fits = [];
  #shown = ""; // id of the fit that is shown
  #looking = 0;
  #sending = null; // the upload under way

  constructor(service, root) {
    this.#service = service;
    this.root = root;
    this.form = root.querySelector("#fit form");
    this.figures = Object.fromEntries(["singular", "gains"].map((name) => [name, new Lines(root.querySelector(`.${name}`))]));
    this.form.addEventListener("submit", (event) => this.#upload(event));
    this.form.querySelector("[name=end]").addEventListener("click", () => this.#sending?.abort());
    const zone = root.querySelector("#fit");
    for (const name of ["dragover", "dragleave", "drop"]) zone.addEventListener(name, (event) => this.#drag(zone, event));
    this.form.addEventListener("input", () => this.#offer());
    document.querySelector("#order").addEventListener("close", () => this.root.hidden || this.look());
    for (const name of ["state", "lost"]) service.addEventListener(name, () => this.#onState());
    this.#offer();
  }

  // The page is looked at: read what there is, and go on for as long as something runs.
  async look() {
    clearTimeout(this.#looking);
    try {
      const [measured, noisy, kept, fits] = await Promise.all(
        ["v1/measurements", "v1/noisy-matrix", "v1/recordings", "v1/fits"].map((path) => this.#service.get(path)));
      this.#matrices = [...measured.measurements, ...noisy.noisy_matrices, ...kept.recordings].sort((a, b) => born(b) - born(a));
      this.#fits = fits.fits.reverse();
      this.#show();
    } catch {
      put(this.root.querySelector(".read"), "the list cannot be read; trying again");
    }
    const running = this.#fits.filter((f) => UNFINISHED.has(f.state)).length;
    const due = running || this.#matrices.some((m) => UNDER_WAY.has(m.state)) || !this.#service.fresh;
    put(document.querySelector('nav [href="#measurements"]'), running ? `Measurements ◐ ${running}` : "Measurements");
    if (due) this.#looking = setTimeout(() => this.look(), LOOK_MS);
  }

  #onState() {
    const { measuring, noisy_measurement } = this.#service.state ?? {};
    const told = JSON.stringify([measuring?.state, noisy_measurement?.state, measuring?.id, noisy_measurement?.id]);
    if (told !== this.told) {
      this.told = told;
      this.look();
    }
  }

  #show() {
    const { now } = this.#service;
    const n = this.#matrices.length;
    put(this.root.querySelector(".read"), n ? `${n}, newest first` : "no matrix or recording yet");
    fill(this.root.querySelector("#matrices tbody"), this.#matrices.map((m) => ("who" in m ? recordingRow(m, now) : this.#matrixRow(m, now))), 6, "none");
    fill(this.root.querySelector("#fits tbody"), this.#fits.map((f) => this.#fitRow(f, now)), 4, "none since the service started");
  }

  #matrixRow(matrix, now) {
    const noisy = "finding" in matrix;
    const path = `v1/${noisy ? "noisy-matrix" : "measurements"}/${encodeURIComponent(matrix.id)}`;
    const found = matrix.finding;
    const size = `${matrix.n_modes ?? matrix.modes.length} modes`;
    const stroke = noisy ? `${nanometres(matrix.total_m)} in total` : nanometres(matrix.amplitude_m?.[0]);
    const says = found ? `signal ${number(found.snr, 1)} × noise; ${shortly(found.alpha, found.sigma)}` : matrix.reason || DASH;
    const acts = make("td", { className: "acts" });
    if (matrix.state === "stored" && noisy) acts.append(download(`${path}/file`, "HDF5"));
    if (matrix.state === "stored" && !noisy) {
      const fit = make("button", { type: "button", text: "Fit" });
      fit.addEventListener("click", () => this.#fitMeasured(matrix.id));
      acts.append(fit, download(`${path}/matrix`, "npy"), download(`${path}/matrix?format=hdf5`, "HDF5"), download(`${path}/matrix?format=fits`, "FITS"));
    }
    if (UNDER_WAY.has(matrix.state)) acts.append("ended above");
    const at = born(matrix);
    return make("tr", {},
      make("th", { scope: "row", text: matrix.id }),
      make("td", { text: noisy ? "noisy, on sky" : matrix.pattern ?? "measured" }),
      make("td", { text: matrix.state }),
      make("td", { text: at ? `${day(at)} ${clock(at)}, ${ago(at, now)}` : DASH }),
      make("td", { text: `${size}, ${stroke}; ${says}` }),
      acts);
  }

  #fitRow(fit, now) {
    const acts = make("td", { className: "acts" });
    const act = (text, what) => {
      const button = make("button", { type: "button", text });
      button.addEventListener("click", what);
      acts.append(button);
    };
    let how = fit.state;
    if (fit.state === "done") act("Show", () => this.#open(fit.id));
    if (fit.state === "failed") how = `cannot be fitted: ${fit.reason}`;
    const cell = make("td", {});
    if (UNFINISHED.has(fit.state)) {
      const k = STAGES.indexOf(fit.stage);
      how = k < 0 ? (fit.state === "running" ? "beginning" : fit.state) : `stage ${k + 1} of ${STAGES.length}, ${fit.stage}`;
      cell.append(bar(make("progress"), k < 0 ? null : k / STAGES.length, `Fit ${fit.name || fit.id}`), ` for ${span((now - milliseconds(fit.asked_ns_utc)) / 1000)}: `);
      if (fit.state !== "receiving") act("Give up", () => this.#giveUp(fit.id));
    }
    cell.append(how);
    const at = milliseconds(fit.asked_ns_utc);
    return make("tr", { className: fit.id === this.#shown ? "in-use" : "" },
      make("th", { scope: "row", text: fit.name || fit.id }),
      make("td", { text: `${day(at)} ${clock(at)}` }), cell, acts);
  }

  async #giveUp(id) {
    const answer = await this.#service.order("DELETE", `v1/fits/${encodeURIComponent(id)}`, null, id);
    if (answer.refused) this.#say(`Refused: ${answer.text}`);
    this.look();
  }

  #fitMeasured(id) {
    this.#post(`v1/fits?${new URLSearchParams({ measurement: id })}`, null);
  }

  // --- files

  #drag(zone, event) {
    event.preventDefault();
    zone.classList.toggle("over", event.type === "dragover");
    if (event.type !== "drop") return;
    const files = [...event.dataTransfer.files];
    const matrices = files.filter((file) => !file.name.endsWith(".toml"));
    const parcel = new DataTransfer();
    // an instrument and what it refers to go together; one matrix alone is the service's own
    for (const file of files.length === matrices.length ? matrices.slice(0, 1) : files.filter((f) => f !== matrices[0])) parcel.items.add(file);
    if (files.length === matrices.length) this.form.matrix.files = parcel.files;
    else {
      this.form.instrument.files = parcel.files;
      const matrix = new DataTransfer();
      if (matrices[0]) matrix.items.add(matrices[0]);
      this.form.matrix.files = matrix.files;
    }
    this.#offer();
  }

  #offer() {
    const [file] = this.form.matrix.files;
    const with_ = [...this.form.instrument.files].map((f) => f.name);
    const whose = with_.length ? `for ${with_.join(", ")}` : "for the instrument of this service";
    this.#say(file ? `${file.name}, ${number(file.size / 1e6, 1)} MB, ${whose}` : "no file chosen yet; choose one, or drop it here");
  }

  #say(text) {
    put(this.form.querySelector(".said"), text);
  }

  async #upload(event) {
    event.preventDefault();
    const [file] = this.form.matrix.files;
    if (!file || this.#sending) return;
    const others = [...this.form.instrument.files];
    const asked = new URLSearchParams({ name: file.name, method: this.form.method.value });
    if (others.length) asked.set("reference", file.name);
    if (this.form.dataset_name.value.trim()) asked.set("dataset", this.form.dataset_name.value.trim());
    try {
      this.#post(`v1/fits?${asked}`, await parcelOf([file, ...others]));
    } catch (error) {
      this.#say(`The file cannot be read here: ${error.message}`); // it has changed or gone since it was chosen
    }
  }

  // An upload tells how far it is, which fetch cannot.
  #post(path, body) {
    const sending = (this.#sending = new XMLHttpRequest());
    const [progress, end] = [this.form.querySelector("progress"), this.form.querySelector("[name=end]")];
    progress.hidden = end.hidden = !body;
    sending.upload.onprogress = ({ loaded, total }) => {
      bar(progress, loaded / total, "Upload");
      this.#say(`◐ sent ${number(loaded / 1e6, 1)} of ${number(total / 1e6, 1)} MB`);
    };
    sending.onloadend = () => {
      this.#sending = null;
      progress.hidden = end.hidden = true;
      const told = read(sending.responseText);
      const over = sending.status === 202 ? `${told.id} is in the queue` : `Refused: ${told.detail ?? "the upload was cancelled, or the service does not answer"}`;
      this.#say(over);
      this.look();
      if (told.id) this.#open(told.id);
    };
    sending.open("POST", path);
    sending.send(body);
  }

  // --- what a fit has found

  async #open(id) {
    this.#shown = id;
    const path = `v1/fits/${encodeURIComponent(id)}`;
    const root = this.root.querySelector("#found");
    let found;
    for (;;) {
      const answer = await fetch(path, { cache: "no-store" }).catch(() => null);
      if (this.#shown !== id) return; // another one is asked for meanwhile
      found = answer && (await answer.json().catch(() => null));
      if (answer && answer.status !== 202) break;
      put(root.querySelector(".verdict"), `◐ ${found?.name || id}: ${found?.stage || found?.state || "requested"}`);
      await new Promise((done) => setTimeout(done, LOOK_MS));
    }
    this.#show();
    const of = this.#fits.find((f) => f.id === id);
    put(root.querySelector("h2"), `Result: ${of?.name || id}`);
    put(root.querySelector(".verdict"), found?.verdict ?? `✕ ${found?.reason ?? found?.detail ?? "no answer"}`);
    root.querySelector(".drawn").hidden = !found?.verdict;
    if (!found?.verdict) return;
    fill(root.querySelector(".links"), [download(path, "all numbers, JSON", `${id}.json`)]);
    const drawn = await this.#service.get(`${path}/figures`).catch(() => null);
    if (this.#shown !== id) return;
    this.#tell(root, found, drawn?.own_instrument);
    if (drawn) this.#draw(root, found, drawn);
  }

  // A registration of another instrument is not held against that of now.
  #tell(root, found, own) {
    const known = own ? this.#service.state?.registration : null;
    const { sigma_statistical: statistical, sigma_systematic: systematic } = found.registration ?? {};
    const parts = (p) => (statistical ? [statistical, systematic].map((s) => rounded(0, s[p.key], p).sigma).join(", ") : DASH);
    fill(root.querySelector("tbody"), PARAMETERS.map((p) => {
      const here = rounded(found[p.key], found.sigma[p.key], p);
      const now = rounded(known?.alpha[p.key], known?.sigma[p.key], p);
      const sigma = Math.hypot(found.sigma[p.key] ?? NaN, known?.sigma[p.key] ?? NaN);
      const apart = (found[p.key] - known?.alpha[p.key]) / sigma;
      return make("tr", {}, make("th", { scope: "row", text: `${p.label}${p.short && `, ${p.short}`}` }),
        make("td", { text: `${here.value} ± ${here.sigma}` }), make("td", { text: parts(p) }), make("td", { text: known ? `${now.value} ± ${now.sigma}` : DASH }),
        make("td", { text: present(apart) ? `${Math.abs(apart) > 3 ? "▲ " : ""}${number(apart, 1)} σ` : DASH }));
    }));
    const { orientation: o } = found;
    const facts = [
      ...(found.recommendation ? [found.recommendation] : []),
      ...(found.registration ? [`Registration ${found.registration.determined ? "" : "not "}determined: ${found.registration.reason}.`] : []),
      ...(found.reconstructor ? [`Reconstructor: ${found.reconstructor.reason}.`] : []),
      `${found.n_modes_used} modes, residual ${number(100 * found.residual_fraction, 1)} %, condition ${number(found.condition_number, 1)}, ${number(found.seconds, 1)} s`,
      `slopes ${o.order}${o.swap_xy ? ", x and y swapped" : ""}${o.flip_x ? ", x flipped" : ""}${o.flip_y ? ", y flipped" : ""}, sign ${o.sign}`,
      ...found.notes,
    ];
    root.querySelector(".facts").replaceChildren(...facts.map((text) => make("li", { text })));
  }

  #draw(root, found, drawn) {
    const { measured, synthetic } = drawn.singular_values;
    this.figures.singular.show({ x: measured.map((_, k) => k + 1), log: true, label: "Singular values relative to the largest",
      lines: [{ name: "measured", values: measured }, { name: "model", values: synthetic }] });
    this.figures.gains.show({ x: drawn.modes, label: "Gain of each mode", lines: [{ name: "measured / model", values: found.gains, dots: true }] });
    const left = drawn.residual_map.flat().filter((v) => v !== null);
    const most = Math.max(1, ...left);
    const four = drawn.residual_map.length === drawn.residual_map[0].length;
    const shown = four ? "the four images" : "Sx next to Sy";
    grid(root.querySelector(".left canvas"), drawn.residual_map, { most, label: `Residual in each subaperture, ${shown}: 0 to ${most} %` });
    put(root.querySelector(".left .legend"), `${four ? "Four images" : "Sx | Sy"}, dark 0 to light ${most} % of the measured RMS`);
    root.querySelector(".maps").replaceChildren(...drawn.maps.map((one) => {
      const canvases = ["measured", "synthetic", "difference"].map((name) => {
        const rows = one[name] ?? one.measured.map((row, y) => row.map((v, x) => (v === null ? null : v - one.synthetic[y][x])));
        const canvas = make("canvas");
        grid(canvas, rows, { signed: true, label: `Mode ${one.mode}, ${name}, ${shown}` });
        return make("figure", {}, canvas, make("figcaption", { text: name === "synthetic" ? "model" : name }));
      });
      return make("div", { className: "map" }, make("h3", { text: `mode ${one.mode}` }), ...canvases);
    }));
    fill(root.querySelector(".by-mode tbody"), drawn.modes.map((mode, k) => make("tr", {}, make("th", { scope: "row", text: String(mode) }),
      make("td", { text: number(found.gains[k], 3) }), make("td", { text: number(100 * drawn.residual_by_mode[k], 1) }))));
  }
}

function recordingRow(recording, now) {
  const { id, state, who, why, reason, n_bytes: size, n_dropped: dropped } = recording;
  const acts = make("td", { className: "acts" });
  acts.append(state === "stored" ? download(`v1/recordings/${encodeURIComponent(id)}/file`, "HDF5", `${id}.h5`) : "ends by itself");
  const at = born(recording);
  const lacks = [dropped && `${dropped} messages lost`, reason].filter(Boolean).join("; ");
  return make("tr", {},
    make("th", { scope: "row", text: id }),
    make("td", { text: "telemetry" }),
    make("td", { text: state }),
    make("td", { text: `${day(at)} ${clock(at)}, ${ago(at, now)}` }),
    make("td", { text: `${number(size / 1e6, 0)} MB, for ${who}: ${why || DASH}${lacks && `; ${lacks}`}` }),
    acts);
}

function born(matrix) {
  return milliseconds(matrix.created_ns_utc ?? matrix.finding?.created_ns_utc ?? matrix.asked_ns_utc) ?? 0;
}

function download(href, text, name = "") {
  return make("a", { href, text, download: name });
}

function read(text) {
  try {
    return JSON.parse(text);
  } catch {
    return {};
  }
}

function fill(element, rows, columns = 1, nothing = "") {
  const empty = element.tagName === "TBODY" && nothing ? [make("tr", {}, make("td", { colspan: String(columns), text: nothing }))] : [];
  element.replaceChildren(...(rows.length ? rows : empty));
}
