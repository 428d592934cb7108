// The mirror on the sensor: where its actuators should be, and where they are, exaggerated.

import { colour } from "./scheme.js";
import { PARAMETERS, DASH, put, fixed, present } from "./words.js";

const CROWDED = 1; // of the distance of two actuators: longer lines are drawn of fewer
const MOST_APART = 8; // subapertures

export class MirrorOnSensor {
  #service;
  #mirror = null;
  #factor = 10;
  #places = [];
  #drawn = []; // of the places, those that are drawn
  #marked = -1;
  #alpha = "";

  constructor(service, root) {
    this.#service = service;
    this.root = root;
    this.canvas = root.querySelector("canvas");
    for (const button of root.querySelectorAll("[data-factor]"))
      button.addEventListener("click", () => this.#exaggerate(Number(button.dataset.factor)));
    this.canvas.addEventListener("pointermove", (event) => this.#point(event));
    this.canvas.addEventListener("pointerleave", () => this.#mark(-1));
    service.addEventListener("state", () => this.#onState());
    service.addEventListener("lost", () => this.#onState());
    document.addEventListener("scheme", () => this.#draw());
    new ResizeObserver(() => this.#draw()).observe(this.canvas);
  }

  get mirror() {
    return this.#mirror;
  }

  set mirror(mirror) {
    this.#mirror = mirror;
    this.#onState(true);
  }

  #exaggerate(factor) {
    this.#factor = factor;
    for (const button of this.root.querySelectorAll("[data-factor]"))
      button.setAttribute("aria-pressed", String(Number(button.dataset.factor) === factor));
    this.#draw();
  }

  #onState(anew = false) {
    const { state, fresh } = this.#service;
    const alpha = fresh ? state?.registration?.alpha ?? null : null;
    this.root.classList.toggle("old", !fresh);
    const told = JSON.stringify(alpha);
    if (!this.#mirror || (!anew && told === this.#alpha)) return;
    this.#alpha = told;
    const nominal = this.#mirror.nominal;
    this.#places = this.#mirror.actuators.map((p) => {
      const from = onSensor(p, nominal);
      return { from, to: alpha ? onSensor(p, alpha) : null };
    });
    this.#tell(alpha);
    this.#draw();
  }

  #tell(alpha) {
    let text = "the registration is not known";
    if (alpha) {
      const far = this.#places.map(({ from, to }) => Math.hypot(to[0] - from[0], to[1] - from[1]));
      const most = far.length ? `farthest actuator ${(100 * Math.max(...far)).toFixed(1)} % of a subaperture from its nominal position` : "actuator positions are not known (measured modes)";
      text = `${most}${stretched(alpha)}`;
    }
    this.text = text;
    this.canvas.setAttribute("aria-label", `Mirror on the sensor: ${text}`);
  }

  #draw() {
    const mirror = this.#mirror;
    if (!mirror || document.hidden) return;
    const { canvas } = this;
    const size = Math.min(canvas.clientWidth, canvas.clientHeight);
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const ctx = canvas.getContext("2d");
    this.#drawn = apart(this.#places, mirror.pupil_diameter_subap * Math.sqrt(Math.PI / 4 / this.#places.length), (place) => this.#shown(place));
    const far = this.#places.flatMap((place) => [place.from, place.to ? this.#shown(place) : place.from]);
    const most = Math.max(mirror.pupil_diameter_subap / 2, ...far.map(([x, y]) => Math.max(Math.abs(x), Math.abs(y))));
    const across = 2 * most + 1;
    const scale = (size / across) * ratio;
    this.scale = scale / ratio;
    // x to the right, y upwards
    ctx.setTransform(scale, 0, 0, -scale, canvas.width / 2, canvas.height / 2);
    this.#cells(ctx, mirror);
    this.#rim(ctx, mirror);
    this.#actuators(ctx);
    const few = this.#drawn.length < this.#places.length ? `; ${this.#drawn.length} of ${this.#places.length} drawn` : "";
    put(this.root.querySelector(".summary"), `${this.text ?? ""}${few}`);
  }

  #cells(ctx, { n_subapertures: n, pupil_diameter_subap: across, obscuration_ratio: hole }) {
    ctx.strokeStyle = colour("line");
    ctx.lineWidth = 0.06;
    ctx.beginPath();
    for (let row = 0; row < n; row++)
      for (let column = 0; column < n; column++) {
        const [x, y] = [column - n / 2, row - n / 2];
        const radius = Math.hypot(x + 0.5, y + 0.5);
        if (radius <= across / 2 && radius >= (hole * across) / 2) ctx.rect(x, y, 1, 1);
      }
    ctx.stroke();
  }

  #rim(ctx, { pupil_diameter_subap: across, obscuration_ratio: hole, stop }) {
    const alpha = this.#service.fresh ? this.#service.state?.registration?.alpha : null;
    const moves = stop === "mirror" && alpha;
    const now = moves ? [alpha.shift_x_subap * this.#factor, alpha.shift_y_subap * this.#factor] : [0, 0];
    for (const [[x, y], stroke, width] of [[[0, 0], colour("nominal"), 0.06], [now, colour("quiet"), 0.12]])
      for (const radius of [across / 2, (hole * across) / 2]) {
        ctx.strokeStyle = stroke;
        ctx.lineWidth = width;
        ctx.beginPath();
        ctx.arc(x, y, radius, 0, 2 * Math.PI);
        ctx.stroke();
      }
  }

  #shown({ from, to }) {
    return from.map((value, axis) => value + this.#factor * (to[axis] - value));
  }

  #actuators(ctx) {
    const few = this.#drawn.length < this.#places.length;
    const dot = (few ? 1.6 : 1) * (this.#places.length > 300 ? 0.16 : 0.14 * Math.sqrt(300 / Math.max(this.#places.length, 30)));
    const thin = Math.max(0.06, 1 / this.scale); // a line is a pixel at least
    for (const place of this.#drawn) {
      const marked = place === this.#places[this.#marked];
      ctx.fillStyle = colour("quiet");
      disc(ctx, place.from, dot * 0.7);
      if (!place.to) continue;
      const now = this.#shown(place);
      ctx.strokeStyle = ctx.fillStyle = marked ? colour("warn") : colour("accent");
      ctx.lineWidth = marked ? 2 * thin : thin;
      ctx.beginPath();
      ctx.moveTo(...place.from);
      ctx.lineTo(...now);
      ctx.stroke();
      disc(ctx, now, marked ? dot * 2 : dot);
    }
  }

  #point(event) {
    if (!this.scale) return;
    const box = this.canvas.getBoundingClientRect();
    const x = (event.clientX - box.left - box.width / 2) / this.scale;
    const y = -(event.clientY - box.top - box.height / 2) / this.scale;
    let [nearest, least] = [-1, 1.5];
    this.#drawn.forEach((place) => {
      const k = this.#places.indexOf(place);
      const [px, py] = place.to ? this.#shown(place) : place.from;
      const far = Math.hypot(px - x, py - y);
      if (far < least) [nearest, least] = [k, far];
    });
    this.#mark(nearest);
  }

  #mark(k) {
    if (k === this.#marked) return;
    this.#marked = k;
    const place = this.#places[k];
    let text = "Point at an actuator to see its displacement.";
    if (place) {
      const moved = place.to ? place.to.map((value, axis) => 100 * (value - place.from[axis])) : [null, null];
      const words = moved.map((value) => (present(value) ? `${value >= 0.05 ? "+" : ""}${fixed(value, 1)}` : DASH));
      text = `actuator ${k}: ${words[0]} %, ${words[1]} % along x, y`;
    }
    put(this.root.querySelector(".actuator"), text);
    this.#draw();
  }
}

// Those of the places that stand so far apart that their lines do not cross: all of them while the lines are short.
function apart(places, pitch, shown) {
  const lengths = places.map((place) => (place.to ? distance(place.from, shown(place)) : 0));
  const longest = Math.max(0, ...lengths);
  if (!(longest > CROWDED * pitch)) return places;
  const least = Math.min(Math.max(longest / 2, 1.5 * pitch), MOST_APART);
  const chosen = [];
  for (const place of places) if (chosen.every(({ from }) => distance(from, place.from) >= least)) chosen.push(place);
  return chosen;
}

// What is known of an anamorphosis, where it is followed.
function stretched({ anamorphosis }) {
  if (!anamorphosis) return "";
  const [along, askew] = anamorphosis.map((value) => `${value < 0 ? "−" : "+"}${Math.abs(100 * value).toFixed(2)} %`);
  return `; stretched by ${along} along x, ${askew} along 45 deg`;
}

function distance([x, y], [otherX, otherY]) {
  return Math.hypot(x - otherX, y - otherY);
}

// A point of the mirror on the sensor: turned and scaled about the pupil's centre, stretched, shifted last.
function onSensor([x, y], alpha) {
  const [shiftX, shiftY, rotation, magnification] = PARAMETERS.map((p) => alpha[p.key]);
  const turn = (rotation * Math.PI) / 180;
  const [along, askew] = alpha.anamorphosis ?? [0, 0];
  const turned = [
    magnification * (x * Math.cos(turn) - y * Math.sin(turn)),
    magnification * (x * Math.sin(turn) + y * Math.cos(turn)),
  ];
  return [
    (1 + along) * turned[0] + askew * turned[1] + shiftX,
    askew * turned[0] + (1 - along) * turned[1] + shiftY,
  ];
}

function disc(ctx, [x, y], radius) {
  ctx.beginPath();
  ctx.arc(x, y, radius, 0, 2 * Math.PI);
  ctx.fill();
}
