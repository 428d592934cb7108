// Whose key this browser keeps, out of the reach of scripts: log in, log out, what may be ordered with it.

import { put } from "./words.js";

const WHERE = "v1/session";

export class Session {
  #service;
  #dialog = document.querySelector("#login");
  #field = document.querySelector("#login-key");
  #button = document.querySelector("#who");
  #name = null;

  constructor(service) {
    this.#service = service;
    this.#dialog.querySelector("form").addEventListener("submit", (event) => this.#logIn(event));
    this.#button.addEventListener("click", () => (this.#name ? this.#logOut() : this.#want()));
    service.addEventListener("closed", () => this.#ask());
    this.#ask();
  }

  // Whether the service lets this browser look; where it does not, the form that asks for a key is shown.
  async #ask() {
    const answer = await fetch(WHERE, { cache: "no-store" }).catch(() => null);
    if (answer?.ok) this.#take(await answer.json());
    else if (answer?.status === 401) this.#want();
  }

  #take({ name, scope }) {
    this.#name = name;
    this.#service.locked = false;
    this.#service.forbidden = scope === "read" ? `key ${name} is read-only: log out, and log in with a key of scope operate` : "";
    this.#button.hidden = !name;
    put(this.#button, `${name} (${scope}): log out`);
  }

  #want() {
    this.#name = null;
    this.#service.locked = true;
    this.#button.hidden = false;
    put(this.#button, "log in");
    if (!this.#dialog.open) this.#dialog.showModal();
  }

  async #logIn(event) {
    event.preventDefault();
    const refused = this.#dialog.querySelector(".refused");
    put(refused, "");
    try {
      const headers = { Authorization: `Bearer ${this.#field.value.trim()}` };
      const answer = await fetch(WHERE, { method: "POST", headers });
      const told = await answer.json();
      if (!answer.ok) return put(refused, `Refused: ${told.detail}`);
      this.#take(told);
    } catch {
      return put(refused, "Wrong key, or the service does not answer.");
    }
    this.#field.value = "";
    this.#dialog.close();
    this.#service.start();
  }

  // What was shown goes with the key.
  async #logOut() {
    await fetch(WHERE, { method: "DELETE" }).catch(() => null);
    location.reload();
  }
}
