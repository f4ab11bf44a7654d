"use strict";
// Light and dark by the system's choice or by the button; paper is light. Who draws hears of it by an event "theme",
// whose detail says whether the picture is needed at once.
(() => {
const root = document.documentElement;
const night = matchMedia("(prefers-color-scheme: dark)");
const tell = (atOnce) => dispatchEvent(new CustomEvent("theme", { detail: atOnce }));
function choose(theme, atOnce = false) {
  if (theme) root.dataset.theme = theme; else delete root.dataset.theme;
  tell(atOnce);
}
document.getElementById("theme").addEventListener("click", () => {
  const shown = root.dataset.theme || (night.matches ? "dark" : "light");
  choose(shown === "dark" ? "light" : "dark");
});
night.addEventListener("change", () => tell(false));
let chosen;
addEventListener("beforeprint", () => { chosen = root.dataset.theme; choose("light", true); });
addEventListener("afterprint", () => choose(chosen));
})();
