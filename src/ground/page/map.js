// The map: drawn in metres around the first thing seen, north up.

import { svg, $ } from "./dom.js";
import { sexagesimal, decimal, mgrs } from "./coords.js";
import { Plane, ellipse, graticuleStep, roundLength, turned } from "./geo.js";
import { isDismissed, isNew, isSilent, known, newestAlarm, sorted } from "./state.js";
import { STATE, metres, title } from "./words.js";
import { attribution, tiles } from "./tiles.js";

const chart = $("chart");
const view = { x: 0, y: 0, scale: 1, following: true }; // centre in metres, pixels per metre
const MIN_SCALE = 1e-4, MAX_SCALE = 200;
let plane = null;

const size = () => ({ w: chart.clientWidth || 1, h: chart.clientHeight || 1 });
function toScreen([x, y]) {
  const { w, h } = size();
  return [w / 2 + (x - view.x) * view.scale, h / 2 - (y - view.y) * view.scale];
}
function fromScreen(px, py) {
  const { w, h } = size();
  return [view.x + (px - w / 2) / view.scale, view.y - (py - h / 2) / view.scale];
}
const place = (lonLat) => toScreen(plane.xy(lonLat));
const bound = (scale) => Math.min(Math.max(scale, MIN_SCALE), MAX_SCALE);

export function forgetPlane() { plane = null; view.following = true; }

// --- what is in view -------------------------------------------------------------------------

function extent() {
  const box = { x0: Infinity, x1: -Infinity, y0: Infinity, y1: -Infinity };
  const add = ([x, y], r = 0) => {
    box.x0 = Math.min(box.x0, x - r); box.x1 = Math.max(box.x1, x + r);
    box.y0 = Math.min(box.y0, y - r); box.y1 = Math.max(box.y1, y + r);
  };
  for (const f of sorted()) add(plane.xy(f.geometry.coordinates), ellipse(f.properties.covariance_enu_m2).major);
  for (const craft of known.aircraft.values()) craft.points.forEach((p) => add(plane.xy(p)));
  return box;
}

function show({ x0, x1, y0, y1 }, least = 12) {
  if (x1 < x0) return;
  const { w, h } = size();
  // Buttons stand at the left, labels reach to the right, the scale lies below.
  const edge = { left: 84, right: Math.min(120, w / 5), top: 44, bottom: 64 };
  view.scale = bound(Math.min((w - edge.left - edge.right) / Math.max(x1 - x0, least), (h - edge.top - edge.bottom) / Math.max(y1 - y0, least)));
  view.x = (x0 + x1) / 2 + (edge.right - edge.left) / 2 / view.scale;
  view.y = (y0 + y1) / 2 - (edge.bottom - edge.top) / 2 / view.scale;
}

export function fit() { view.following = true; draw(); }

/** Brings one incident close. */
export function approach(feature) {
  if (!plane || !feature) return;
  view.following = false;
  const [x, y] = plane.xy(feature.geometry.coordinates), r = 4 * Math.max(ellipse(feature.properties.covariance_enu_m2).major, 3);
  show({ x0: x - r, x1: x + r, y0: y - r, y1: y + r });
  draw();
}

export function zoom(factor, px, py) {
  const { w, h } = size();
  const [ax, ay] = [px ?? w / 2, py ?? h / 2];
  const [x, y] = fromScreen(ax, ay);
  view.scale = bound(view.scale * factor);
  view.x = x - (ax - w / 2) / view.scale;
  view.y = y + (ay - h / 2) / view.scale;
  view.following = false;
  draw();
}

export function pan(dx, dy) {
  view.x -= dx / view.scale;
  view.y += dy / view.scale;
  view.following = false;
  draw();
}

// --- drawing ---------------------------------------------------------------------------------

// Lines of latitude and longitude at round steps, named at the edges.
function graticule() {
  const { w, h } = size(), group = svg("g", { class: "graticule", "aria-hidden": "true" });
  const [west, south] = plane.lonLat(fromScreen(0, h)), [east, north] = plane.lonLat(fromScreen(w, 0));
  const perPixel = (east - west) / w;
  const lines = (from, to, draw) => {
    const step = graticuleStep(150 * perPixel), digits = step < 1 / 36000 ? 2 : step < 1 / 3600 ? 1 : 0;
    for (let k = Math.ceil(from / step); k * step < to && k < from / step + 60; k += 1) draw(k * step, digits);
  };
  const line = (x1, y1, x2, y2) => group.append(svg("line", { x1, y1, x2, y2 }));
  const label = (x, y, text, anchor) => group.append(svg("text", { x, y, "text-anchor": anchor }, text));
  lines(west, east, (lon, digits) => {
    const [x] = place([lon, south]);
    line(x, 0, x, h);
    if (x > 190 && x < w - 60) label(x + 4, h - 8, sexagesimal(turned(lon), "E", "W", digits), "start");
  });
  lines(south, north, (lat, digits) => {
    const [, y] = place([west, lat]);
    line(0, y, w, y);
    if (y > 70 && y < h - 60) label(w - 6, y - 4, sexagesimal(lat, "N", "S", digits), "end");
  });
  return group;
}

function craftMark([uav, craft], taken) {
  const line = craft.points.map((p) => place(p).map((v) => v.toFixed(1)).join(",")).join(" ");
  const { latest } = craft;
  const [x, y] = place([latest.longitude_deg, latest.latitude_deg]);
  const body = latest.heading_deg === null
    ? svg("circle", { r: 6 })
    : svg("path", { d: "M0,-13 L8,10 L0,5 L-8,10Z", transform: `rotate(${latest.heading_deg})` });
  const silent = isSilent(craft);
  const label = svg("text", { class: "label" }, uav, silent ? svg("tspan", { class: "fine" }, "  silent") : "");
  const mark = svg("g", { class: `craft${silent ? " silent" : ""}`, transform: `translate(${x},${y})` }, body, label);
  beside(label, [x, y], taken);
  return [svg("polyline", { class: `track${silent ? " silent" : ""}`, points: line }), mark];
}

// Places a label beside a sign where it covers no other: right, left, below, above, else right.
function beside(label, [x, y], taken) {
  const width = 7.7 * label.textContent.length, height = 18;
  const spots = [
    [15, 5, "start", 15], [-15, 5, "end", -15 - width],
    [0, 29, "middle", -width / 2], [0, -19, "middle", -width / 2],
  ].map(([dx, dy, anchor, left]) => ({ dx, dy, anchor, box: [x + left, y + dy - 14, x + left + width, y + dy - 14 + height] }));
  const clear = ({ box }) => taken.every((t) => box[2] < t[0] || box[0] > t[2] || box[3] < t[1] || box[1] > t[3]);
  const inside = ({ box }) => box[0] > (box[1] < 200 ? 64 : 2) && box[2] < size().w - 2;
  const spot = spots.find((s) => clear(s) && inside(s)) ?? spots[0];
  taken.push(spot.box);
  for (const [key, value] of [["x", spot.dx], ["y", spot.dy], ["text-anchor", spot.anchor]]) label.setAttribute(key, value);
}

// Burning ground and front line, in the mark's own coordinates.
function burning(alarm, [x, y]) {
  const area = alarm?.properties.area;
  if (!area?.polygon?.length || alarm.properties.state === "out") return [];
  const path = (corners) => corners.map((corner, k) => {
    const [px, py] = place(corner);
    return `${k ? "L" : "M"}${(px - x).toFixed(1)},${(py - y).toFixed(1)}`;
  }).join(" ");
  const { polygon } = area, ground = svg("path", { class: "ground", d: `${path(polygon)}Z` });
  // The front's corners may run over the polygon's seam: begin after the gap.
  const inFront = new Set(area.front.map(String));
  const start = polygon.findIndex((c, k) => inFront.has(String(c)) && !inFront.has(String(polygon.at(k - 1))));
  if (start < 0) return [ground];
  const turned = [...polygon.slice(start), ...polygon.slice(0, start)].filter((c) => inFront.has(String(c)));
  return [ground, svg("path", { class: "front", d: path(turned) })];
}

// Where each aircraft has it, when several do.
function members(p, [x, y]) {
  if (p.alarms.length < 2) return [];
  return p.alarms.map((alarm) => {
    const [px, py] = place(alarm.coordinates);
    const [dx, dy] = [px - x, py - y];
    return svg("g", { class: "member" }, svg("line", { x1: 0, y1: 0, x2: dx, y2: dy }),
      svg("path", { d: `M${dx - 4},${dy - 4} l8,8 m0,-8 l-8,8` }));
  });
}

function fireMark(feature, taken) {
  const p = feature.properties, [x, y] = place(feature.geometry.coordinates);
  const { major, minor, degrees } = ellipse(p.covariance_enu_m2);
  const isChosen = feature.id === known.chosen;
  const mark = svg("g", {
    class: "mark", "data-id": feature.id, "data-class": p.class, "data-state": isDismissed(p) ? "out" : p.state,
    "data-chosen": String(isChosen), "data-new": String(isNew(p)), transform: `translate(${x},${y})`,
    role: "button", tabindex: "0",
  });
  const [ground, front] = burning(newestAlarm(feature.id), [x, y]);
  if (ground) mark.append(ground);
  if (isNew(p)) mark.append(svg("circle", { class: "halo", r: 20 }));
  // SVG turns clockwise with y down; the ellipse's direction runs from east towards north.
  mark.append(svg("ellipse", { class: "ring", rx: major * view.scale, ry: minor * view.scale, transform: `rotate(${-degrees})` }));
  if (isChosen) mark.append(...members(p, [x, y]));
  mark.append(p.class === "smoke" ? svg("circle", { class: "sign", r: 6 }) : svg("path", { class: "sign", d: "M0,-9 L8,5 L-8,5Z" }));
  if (front) mark.append(front);
  const told = size().w > 500 && p.state !== "confirmed" ? `, ${STATE[p.state] ?? p.state}` : "";
  const label = svg("text", { class: "label" }, feature.id, svg("tspan", { class: "fine" }, `  ±${metres(p.ce90_m)}${told}`));
  beside(label, [x, y], taken);
  mark.append(label);
  mark.setAttribute("aria-label", `${label.textContent}: ${title(p)}, within ${metres(p.ce90_m)} at 90 percent`);
  return mark;
}

export function draw() {
  const incidents = sorted(), things = incidents.length + known.aircraft.size;
  $("empty").hidden = things > 0;
  $("scale").hidden = !things;
  if (!things) { chart.replaceChildren(); return; }
  plane ??= new Plane(firstPlace(incidents));
  if (view.following) show(extent());
  const focused = document.activeElement?.dataset?.id;
  const taken = incidents.map((f) => place(f.geometry.coordinates)).map(([x, y]) => [x - 9, y - 9, x + 9, y + 9]);
  const fires = incidents.map((f) => fireMark(f, taken)).reverse(); // the most urgent is drawn last, on top
  const crafts = [...known.aircraft].map((entry) => craftMark(entry, taken));
  chart.replaceChildren(tiles(plane, place, fromScreen, size(), view.scale), graticule(),
    ...crafts.map(([track]) => track), ...fires, ...crafts.map(([, mark]) => mark));
  if (focused) [...chart.querySelectorAll(".mark")].find((m) => m.dataset.id === focused)?.focus();
  drawScale();
}

function drawScale() {
  const length = roundLength(150 / view.scale);
  $("scale-text").textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
  $("scale-bar").style.width = `${length * view.scale}px`;
  $("attribution").textContent = attribution();
}

function firstPlace(incidents) {
  const [craft] = known.aircraft.values();
  return incidents.length ? incidents[0].geometry.coordinates : craft.points[0];
}

// --- hands -----------------------------------------------------------------------------------

function point([px, py]) {
  if (!plane) return;
  const [east, lat] = plane.lonLat(fromScreen(px, py)), lon = turned(east);
  $("pointer").textContent = `${decimal(lat, lon)}  ${mgrs(lat, lon) ?? ""}`;
}

/** Fingers, mouse and wheel; `pick` is called with the id of a mark that was touched. */
export function listen(pick) {
  const fingers = new Map();
  let moved = 0;
  chart.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    moved = 0;
  });
  chart.addEventListener("pointermove", (event) => {
    const at = [event.offsetX, event.offsetY], before = fingers.get(event.pointerId);
    if (!before) { point(at); return; }
    const step = [at[0] - before[0], at[1] - before[1]];
    moved += Math.hypot(...step);
    if (moved < 4) return;
    if (!chart.hasPointerCapture(event.pointerId)) chart.setPointerCapture(event.pointerId);
    chart.classList.add("dragging");
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    fingers.set(event.pointerId, at);
    if (!other) { pan(...step); return; }
    const reach = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
    zoom(reach(at) / reach(before), (at[0] + other[0]) / 2, (at[1] + other[1]) / 2);
  });
  const lift = (event) => {
    fingers.delete(event.pointerId);
    chart.classList.remove("dragging");
  };
  chart.addEventListener("pointerup", lift);
  chart.addEventListener("pointercancel", lift);
  chart.addEventListener("pointerleave", () => { $("pointer").textContent = ""; });
  chart.addEventListener("click", (event) => {
    const mark = event.target.closest(".mark");
    if (mark && moved < 4) pick(mark.dataset.id);
  });
  chart.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
  }, { passive: false });
  chart.addEventListener("keydown", (event) => mapKey(event, pick));
  new ResizeObserver(draw).observe(chart);
}

function mapKey(event, pick) {
  const { id } = event.target.dataset;
  const keys = {
    ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60),
    Enter: () => id && pick(id), " ": () => id && pick(id),
  };
  if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  event.stopPropagation();
  keys[event.key]();
}
