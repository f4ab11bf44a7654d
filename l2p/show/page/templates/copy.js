"use strict";
// Buttons that copy a command.
(() => {
for (const button of document.querySelectorAll("button.copy")) {
  const label = button.textContent;
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(button.dataset.copy);
      button.textContent = "Copied";
    } catch {
      // Without the right to write to the clipboard, the command is shown, selected, to be copied by hand.
      window.prompt("Copy this command:", button.dataset.copy);
    }
    setTimeout(() => { button.textContent = label; }, 1500);
  });
}
})();
