// The keyboard, and the page that names its keys.

import { $, html } from "./dom.js";

const HELP = [
  ["j, k", "next, previous incident"], ["Enter", "open or close it"], ["a", "acknowledge"], ["c", "confirm"], ["d", "no fire"],
  ["m", "same fire as another"], ["u", "take back the last action"], ["y", "copy its coordinates"], ["z", "bring it close on the map"],
  ["0", "fit everything"], ["+, −, arrows", "zoom and pan the map"], ["s", "sound on or off"], ["t", "dark, light, as the system"],
  ["?", "this help"], ["Esc", "close"],
];

export function listen(keys) {
  $("keys").append(...HELP.flatMap(([key, what]) => [html("dt", {}, key), html("dd", {}, what)]));
  const all = { ...keys, "?": toggleHelp };
  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest("input, textarea, select, dialog[open]");
    if (typing || event.ctrlKey || event.metaKey || event.altKey || !all[event.key]) return;
    event.preventDefault();
    all[event.key]();
  });
  $("help").addEventListener("click", toggleHelp);
}

function toggleHelp() {
  if ($("help-dialog").open) $("help-dialog").close(); else $("help-dialog").showModal();
}
