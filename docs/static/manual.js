// Runs before the page is drawn. The theme does this in an inline script, which the service's
// Content-Security-Policy refuses.
document.documentElement.dataset.mode = localStorage.getItem("mode") || "auto";
document.documentElement.dataset.theme = localStorage.getItem("theme") || "light";
// Icons get their size from manual.css; a style element made by a script would be refused.
window.FontAwesomeConfig = { autoAddCss: false };
document.addEventListener("DOMContentLoaded", () => {
  if (document.querySelector("#search-results")) document.querySelector("form.bd-search input")?.focus();
});
