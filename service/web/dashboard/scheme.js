// Night or day: what canvases are drawn in, from the style sheet, so that each colour is written once.

const KEPT = "pyrcal.scheme.chosen"; // kept by this browser
const LIGHT = globalThis.matchMedia?.("(prefers-color-scheme: light)"); // what the computer is set to

let known = {};

export function colour(name) {
  known[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return known[name];
}

export function scheme() {
  return document.documentElement.dataset.scheme === "day" ? "day" : "night";
}

// What was chosen here, else what the computer is set to, which may change with the hour.
export function choose(chosen = localStorage.getItem(KEPT)) {
  const name = chosen ?? (LIGHT?.matches ? "day" : "night");
  if (chosen) localStorage.setItem(KEPT, chosen);
  document.documentElement.dataset.scheme = name;
  document.querySelector("meta[name=color-scheme]").content = name === "day" ? "light" : "dark";
  known = {};
  document.dispatchEvent(new CustomEvent("scheme"));
}

LIGHT?.addEventListener("change", () => choose());
