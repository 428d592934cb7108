// The operator's page: what is known, what wants a decision, and the keys.

import { showButtons, showConnection, showHeader, showLoop, showProvenance, showReconstructors, showWaiting, showWork } from "./cards.js";
import { Events } from "./events.js";
import { MirrorOnSensor } from "./mirror.js";
import { Orders } from "./orders.js";
import { Registration } from "./registration.js";
import { Service } from "./stream.js";

const service = new Service();
const orders = new Orders(service);
const registration = new Registration(service, document.querySelector("#registration"));
const mirror = new MirrorOnSensor(service, document.querySelector("#mirror"));
new Events(service, document.querySelector("#events"));
const help = document.querySelector("#help");

function show() {
  showConnection(service);
  showHeader(service, orders);
  showWaiting(service, orders);
  showWork(service, orders);
  showProvenance(service, orders);
  showLoop(service, mirror.mirror);
  showButtons(orders);
}

for (const name of ["state", "lost", "tick", "reconstructors"]) service.addEventListener(name, show);
service.addEventListener("reconstructors", () => showReconstructors(service, orders));
setInterval(() => showReconstructors(service, orders), 10_000); // how long ago each was made
service.addEventListener("reset", async () => {
  try {
    mirror.mirror = registration.mirror = await service.get("v1/mirror");
  } catch {
    // the next reset asks again
  }
});

for (const button of document.querySelectorAll("[data-order], #work-end"))
  button.addEventListener("click", () => orders.open(button.dataset.order));
document.querySelector("#mode").addEventListener("change", (event) => {
  const { value } = event.target;
  event.target.value = service.state?.mode ?? value;
  event.target.blur();
  orders.open("mode", value);
});

// What a card shows: its "?" opens the help where it speaks of it.
for (const button of document.querySelectorAll("[data-help]"))
  button.addEventListener("click", () => {
    help.showModal();
    document.getElementById(button.dataset.help)?.scrollIntoView();
  });
help.querySelector("button").addEventListener("click", () => help.close());

const KEYS = {
  a: () => orders.open("approve"),
  r: () => orders.open("rollback"),
  h: () => orders.open("hold"),
  1: () => registration.choose(1),
  2: () => registration.choose(2),
  3: () => registration.choose(3),
  "?": () => help.showModal(),
};

document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, textarea, select, dialog");
  if (typing || event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  const act = KEYS[event.key];
  if (!act) return;
  event.preventDefault();
  act();
});

service.start();
show();
