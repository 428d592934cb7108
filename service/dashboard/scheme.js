// Night or day: what canvases are drawn in, from the style sheet, so that each colour is written once.

const KEPT = "pyrcal.scheme"; // what was chosen here, kept by this browser

let known = {};

export function colour(name) {
  known[name] ??= getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  return known[name];
}

export function scheme() {
  return document.documentElement.dataset.scheme === "day" ? "day" : "night";
}

// Night unless somebody chose day here: that a computer prefers light is no reason to light a control room.
export function choose(name = localStorage.getItem(KEPT) ?? "night") {
  document.documentElement.dataset.scheme = name;
  document.querySelector("meta[name=color-scheme]").content = name === "day" ? "light" : "dark";
  localStorage.setItem(KEPT, name);
  known = {};
  document.dispatchEvent(new CustomEvent("scheme"));
}
