// Sound and notifications: what calls a person who looks elsewhere.

import { $ } from "./dom.js";
import { isNew, known } from "./state.js";
import { name, title } from "./words.js";

const REPEAT_MS = 20000; // a new fire calls again until somebody acknowledges it
let audio = null;
let calledAt = 0;

const isOn = (key) => localStorage.getItem(key) === "on";

function tone(at, hertz) {
  const source = audio.createOscillator(), level = audio.createGain();
  source.frequency.value = hertz;
  level.gain.setValueAtTime(0, at);
  level.gain.linearRampToValueAtTime(0.25, at + 0.02);
  level.gain.setValueAtTime(0.25, at + 0.22);
  level.gain.linearRampToValueAtTime(0, at + 0.3);
  source.connect(level).connect(audio.destination);
  source.start(at);
  source.stop(at + 0.32);
}

/** Two rising tones, twice. */
function ring() {
  if (!isOn("sound") || audio?.state !== "running") return;
  const start = audio.currentTime;
  [0, 0.35, 0.9, 1.25].forEach((after, k) => tone(start + after, k % 2 ? 988 : 740));
}

function notify(feature) {
  if (!isOn("notify") || globalThis.Notification?.permission !== "granted") return;
  const p = feature.properties;
  const shown = new Notification(title(p), { body: `${p.id}, ±${p.ce90_m.toFixed(1)} m`, tag: p.id, icon: "/icons/fire.png" });
  shown.onclick = () => { window.focus(); location.hash = encodeURIComponent(p.id); };
}

/** Called for every change: `before` is what the incident was, if it was known. */
export function heed(feature, before, isFresh) {
  const p = feature.properties;
  if (!before || before.state !== p.state) $("announce").textContent = `${before ? "" : "New: "}${name(p)}, ${title(p)}`;
  const becameNew = isNew(p) && (!before || !isNew(before));
  if (!becameNew || !isFresh) return;
  calledAt = Date.now();
  ring();
  notify(feature);
}

/** Once a second: calls again while something is new. */
export function tick() {
  const waits = [...known.incidents.values()].some((f) => isNew(f.properties));
  if (!waits || Date.now() - calledAt < REPEAT_MS) return;
  calledAt = Date.now();
  ring();
}

function show() {
  const sound = isOn("sound"), blocked = sound && audio?.state !== "running";
  $("sound").setAttribute("aria-pressed", String(sound));
  $("sound").textContent = blocked ? "Sound: click to allow" : sound ? "Sound on" : "Sound off";
  const notes = isOn("notify") && globalThis.Notification?.permission === "granted";
  $("notify").setAttribute("aria-pressed", String(notes));
  $("notify").textContent = notes ? "Notices on" : "Notices off";
  $("notify").hidden = !globalThis.Notification;
}

async function wake() {
  audio ??= new AudioContext();
  await audio.resume();
  show();
}

export async function toggleSound() {
  const blocked = isOn("sound") && audio?.state !== "running";
  if (!blocked) localStorage.setItem("sound", isOn("sound") ? "off" : "on");
  await wake();
  ring();
}

async function toggleNotices() {
  const on = isOn("notify") && Notification.permission === "granted";
  if (!on && Notification.permission !== "granted") await Notification.requestPermission();
  localStorage.setItem("notify", on ? "off" : "on");
  show();
}

export function listen() {
  if (localStorage.getItem("sound") === null) localStorage.setItem("sound", "on");
  $("sound").addEventListener("click", toggleSound);
  $("notify").addEventListener("click", toggleNotices);
  // Browsers let a page sound only after a hand has touched it.
  document.addEventListener("pointerdown", () => isOn("sound") && wake(), { once: true });
  document.addEventListener("keydown", () => isOn("sound") && wake(), { once: true });
  show();
}
