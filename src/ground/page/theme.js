// Dark, light, or as the system has it.

import { $ } from "./dom.js";

const ORDER = ["system", "dark", "light"];
const given = () => (ORDER.includes(localStorage.getItem("theme")) ? localStorage.getItem("theme") : "system");

function show() {
  if (given() === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = given();
  $("theme").textContent = { system: "Auto", dark: "Dark", light: "Light" }[given()];
}

export function next() {
  localStorage.setItem("theme", ORDER[(ORDER.indexOf(given()) + 1) % ORDER.length]);
  show();
}

export function listen() {
  $("theme").addEventListener("click", next);
  show();
}
