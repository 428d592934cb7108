// The operator's page: what is known, what wants a decision, and the keys.

import { CriticalBanner, showAlarmLines } from "./alarms.js";
import { showButtons, showConnection, showHeader, showLoop, showProvenance, showReconstructors, showWaiting, showWork } from "./cards.js";
import { Events } from "./events.js";
import { Large } from "./large.js";
import { MirrorOnSensor } from "./mirror.js";
import { Orders } from "./orders.js";
import { Registration } from "./registration.js";
import { choose, scheme } from "./scheme.js";
import { Session } from "./session.js";
import { Service } from "./stream.js";
import { lay } from "./words.js";

lay(document);
const service = new Service();
new Session(service);
const orders = new Orders(service);
const registration = new Registration(service, document.querySelector("#registration"));
const mirror = new MirrorOnSensor(service, document.querySelector("#mirror"));
new Events(service, orders, document.querySelector("#events"));
const $ = (selector) => document.querySelector(selector);
const banner = new CriticalBanner(service, orders);
const large = new Large(service, orders, $("#large"));
const help = $("#help");

// The other pages are fetched when they are looked at first.
const PAGES = {
  measurements: async (root) => new (await import("./measurements.js")).Measurements(service, root),
  history: async (root) => new (await import("./history.js")).History(service, orders, root),
};
const pages = {};

async function fetched(name) {
  const answer = await fetch(`dashboard/${name}.html`);
  if (!answer.ok) throw new Error(`${name}: ${answer.status}`);
  const { body } = new DOMParser().parseFromString(await answer.text(), "text/html");
  const root = $(`#${name}`);
  lay(body);
  root.replaceChildren(...body.children);
  return PAGES[name](root);
}

async function turnTo() {
  const wanted = location.hash.slice(1);
  const name = wanted in PAGES || wanted === "large" ? wanted : "operate";
  for (const main of document.querySelectorAll("main")) main.hidden = main.id !== name;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.hash === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.body.dataset.page = name;
  large.show();
  if (!PAGES[name]) return;
  try {
    pages[name] ??= fetched(name);
    await (await pages[name]).look();
  } catch {
    delete pages[name];
    orders.say(`the page ${name} cannot be loaded: the service does not answer; try again`);
  }
}

function showScheme() {
  const day = scheme() === "day";
  $("#scheme").textContent = day ? "☾" : "☀";
  $("#scheme").title = day ? "night: light on dark" : "day: dark on light";
}

function show() {
  showConnection(service);
  showHeader(service, orders);
  banner.show();
  showAlarmLines(service);
  large.show();
  showWaiting(service, orders);
  showWork(service, orders);
  showProvenance(service, orders);
  showLoop(service, mirror.mirror);
  showButtons(orders);
}

for (const name of ["state", "lost", "tick", "reconstructors"]) service.addEventListener(name, show);
service.addEventListener("reconstructors", () => showReconstructors(service, orders));
setInterval(() => showReconstructors(service, orders), 10_000); // how long ago each was made
async function drawMirror() {
  try {
    mirror.mirror = registration.mirror = await service.get("v1/mirror");
  } catch {
    // the next reset asks again
  }
}
service.addEventListener("reset", drawMirror);
// a sensor that is binned otherwise has other subapertures, once its model is there
let drawn;
service.addEventListener("state", () => {
  const { config_id } = service.state;
  if (config_id !== drawn && service.state.ready) {
    if (drawn !== undefined) drawMirror();
    drawn = config_id;
  }
});

document.addEventListener("click", ({ target }) => {
  const button = target.closest("[data-order], [data-help]");
  if (button?.dataset.order) orders.open(button.dataset.order);
  if (!button?.dataset.help) return;
  help.showModal(); // where it speaks of what the button stands by
  document.getElementById(button.dataset.help)?.scrollIntoView();
});
document.querySelector("#mode").addEventListener("change", (event) => {
  const { value } = event.target;
  event.target.value = service.state?.mode ?? value;
  event.target.blur();
  orders.open("mode", value);
});

help.querySelector("button").addEventListener("click", () => help.close());

function chooseRange(range) {
  location.hash = "operate";
  registration.choose(range);
}

const KEYS = {
  a: () => orders.open("approve"),
  r: () => orders.open("rollback"),
  h: () => orders.open("hold"),
  1: () => chooseRange(1),
  2: () => chooseRange(2),
  3: () => chooseRange(3),
  m: () => (location.hash = "measurements"),
  o: () => (location.hash = "operate"),
  y: () => (location.hash = "history"),
  b: () => (location.hash = document.body.dataset.page === "large" ? "operate" : "large"),
  "?": () => help.showModal(),
};

// While a dialog is open, or on its way, no key does anything but what it does there.
document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, textarea, select") || orders.opening || $("dialog[open]");
  if (typing || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  const act = KEYS[event.key];
  if (!act) return;
  event.preventDefault();
  act();
});

// What is only glanced at, and what many telescopes do not have, comes after what is looked for.
service.addEventListener("reconstructors", async () => new (await import("./glance.js")).Glance(service, orders, $("#glance")), { once: true });
service.addEventListener("state", async () => new (await import("./references.js")).References(service, orders, $("#held")), { once: true });

window.addEventListener("hashchange", () => {
  turnTo();
  const place = document.getElementById(location.hash.slice(1));
  if (place?.tagName === "MAIN") place.focus(); // who cannot see is where the page begins
});
$("#scheme").addEventListener("click", () => choose(scheme() === "day" ? "night" : "day"));
document.addEventListener("scheme", showScheme);

choose();
turnTo();
service.start();
show();
